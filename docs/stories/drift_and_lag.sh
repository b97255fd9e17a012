# Drift or lag? Run in an empty folder: sh drift_and_lag.sh
set -e
# two lines whose darks are brighter at the end of the day than at its beginning
raytwin lab -o drift.h5 --protocol short --effect dark_drift=6 --seed 32
raytwin lab -o lag.h5 --protocol short --effect image_lag=0.05 --seed 32
raytwin diagnose drift.h5 -o drift
raytwin diagnose lag.h5 -o lag
# the second line without the right name in the catalogue, and then with everything that can be measured
raytwin diagnose lag.h5 -o without_lag --without image_lag
raytwin lab -o lag_full.h5 --protocol full --effect image_lag=0.05 --seed 32
raytwin diagnose lag_full.h5 -o lag_full
# what it means for detection
raytwin lab -o products.h5 --protocol products --session 1 --products 72 --frames 20 --bones-mm 1,1.5,2,2.5,3,4 \
  --effect image_lag=0.05 --seed 32
raytwin diagnose lag.h5 -o with_pod --task products.h5
