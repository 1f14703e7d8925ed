"""`python -m motor_datasets`."""

import sys

from motor_datasets.cli import main

sys.exit(main())
