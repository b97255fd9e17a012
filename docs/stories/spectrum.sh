# A spectral gap. Run in an empty folder: sh spectrum.sh
set -e
# a layer in the beam since the calibration, seen at one tube voltage only
raytwin lab -o session.h5 --protocol short --effect filtration_error=0.1 --leave-out low_kV --seed 33
raytwin diagnose session.h5 -o first
# what the answer asks for, on another day: flats at two voltages behind a known filter, two materials of known thickness
raytwin lab -o more.h5 --protocol full --session 1 --only wedge --only filtered_flats \
  --effect filtration_error=0.1@always --seed 33
# products of a third day, for what it means for detection
raytwin lab -o products.h5 --protocol products --session 2 --products 96 --frames 20 --bones-mm 1,1.5,2,2.5,3,4 \
  --effect filtration_error=0.1@always --seed 33
raytwin diagnose session.h5 -o second --also more.h5 --task products.h5
