"""`python -m sim_backend MACHINE --socket PATH`: the software rig as a process."""

import sys

from sim_backend.process import main

sys.exit(main())
