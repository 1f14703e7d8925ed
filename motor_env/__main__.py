"""`python -m motor_env`."""

import sys

from motor_env.cli import main

sys.exit(main())
