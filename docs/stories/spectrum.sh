# A spectral gap. Run in an empty folder: sh spectrum.sh
set -e
# the voltage is 2 % lower since the calibration; on another day, with products, it is so from the first flat on
raytwin lab --family none --no-unkindness -o session.h5 --protocol full --effect kv_error=-2 --seed 33
raytwin lab --family none --no-unkindness -o products.h5 --protocol products --session 1 --products 96 --frames 20 --bones-mm 0.7,1,1.4,2,2.8,4 \
  --effect kv_error=-2@always --seed 33
raytwin diagnose session.h5 -o diagnosis --task products.h5
