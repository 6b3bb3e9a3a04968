"""`python -m pcdenoise` is the same as `pcdenoise`."""

import sys

from pcdenoise.commands import main

sys.exit(main())
