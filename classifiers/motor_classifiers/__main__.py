"""`python -m motor_classifiers`."""

import sys

from motor_classifiers.cli import main

sys.exit(main())
