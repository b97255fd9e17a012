# A spectral gap. Run in an empty folder: sh spectrum.sh
set -e
# a layer in the beam since the calibration, seen at one tube voltage only
raytwin lab -o one_voltage.h5 --protocol short --effect filtration_error=0.1 --leave-out low_kV --seed 33
raytwin diagnose one_voltage.h5 -o one_voltage
# the same line at two voltages
raytwin lab -o two_voltages.h5 --protocol short --effect filtration_error=0.1 --seed 33
raytwin diagnose two_voltages.h5 -o plan --plan
raytwin diagnose two_voltages.h5 -o two_voltages
# another day: the layer is there from its first flat on
raytwin lab -o products.h5 --protocol products --session 1 --products 72 --frames 20 --bones-mm 1,1.5,2,2.5,3,4 \
  --effect filtration_error=0.1@always --seed 33
raytwin diagnose two_voltages.h5 -o with_pod --task products.h5
