# A tie, and the measurement that breaks it. Run in an empty folder: sh tie.sh
set -e
# a layer in the beam since the calibration, seen at one tube voltage only
raytwin lab --family none --no-unkindness -o session.h5 --protocol short --effect filtration_error=0.1 --leave-out low_kV --seed 33
raytwin diagnose session.h5 -o first
# two materials and flats at two voltages, but after the change alone
raytwin lab --family none --no-unkindness -o more.h5 --protocol full --session 1 --only wedge --only filtered_flats \
  --effect filtration_error=0.1@always --seed 33
raytwin diagnose session.h5 -o second --also more.h5
# a second voltage before the change as well
raytwin lab --family none --no-unkindness -o whole.h5 --protocol short --effect filtration_error=0.1 --seed 33
raytwin diagnose whole.h5 -o third
