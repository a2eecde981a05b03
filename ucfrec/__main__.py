"""Makes `python -m ucfrec` run the command `ucfrec`."""

import sys

from ucfrec.commands.cli import main

sys.exit(main())
