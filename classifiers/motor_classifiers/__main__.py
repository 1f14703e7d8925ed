"""`python -m motor_classifiers`."""

import sys

from motor_classifiers.cli.main import main

sys.exit(main())
