# Drift or lag? Run in an empty folder: sh drift_and_lag.sh
set -e
# two lines whose darks are brighter at the end of the day than at its beginning
raytwin lab --family none --no-unkindness -o drift.h5 --protocol short --effect dark_drift=6 --seed 32
raytwin lab --family none --no-unkindness -o lag.h5 --protocol short --effect image_lag=0.05 --seed 32
raytwin diagnose drift.h5 -o drift
# the second one, and what it means for detection
raytwin lab --family none --no-unkindness -o products.h5 --protocol products --session 1 --products 96 --frames 20 --bones-mm 1,1.5,2,2.5,3,4 \
  --effect image_lag=0.05 --seed 32
raytwin diagnose lag.h5 -o lag --task products.h5
# the same line with everything that can be measured, beam-off frames too
raytwin lab --family none --no-unkindness -o full.h5 --protocol full --effect image_lag=0.05 --seed 32
raytwin diagnose full.h5 -o full
