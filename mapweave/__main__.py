"""`python -m mapweave` is the same as `mapweave`."""

import sys

from mapweave.cli import main

sys.exit(main())
