"""`python -m raytwin`."""

import sys

from .cli import main

sys.exit(main())
