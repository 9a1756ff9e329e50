"""`python -m mapweave` is the same as `mapweave`."""

import sys

from mapweave.start import main

sys.exit(main())
