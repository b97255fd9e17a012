# A scatter gap. Run in an empty folder: sh scatter.sh
set -e
raytwin lab --family none --no-unkindness -o session.h5 --protocol full --effect object_scatter=6 --seed 31
# another day of the same line: products with bones, some of them near the limit
raytwin lab --family none --no-unkindness -o products.h5 --protocol products --session 1 --products 96 --frames 20 --bones-mm 1,1.5,2,2.5,3,4 \
  --effect object_scatter=6 --seed 31
raytwin diagnose session.h5 -o diagnosis --task products.h5
