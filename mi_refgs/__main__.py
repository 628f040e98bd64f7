"""`python -m mi_refgs` is `refgs`."""

import sys

from mi_refgs.cli import main

sys.exit(main())
