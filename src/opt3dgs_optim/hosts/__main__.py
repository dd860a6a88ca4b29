"""`python -m opt3dgs_optim.hosts`."""

import sys

from opt3dgs_optim.hosts.cli import main

sys.exit(main())
