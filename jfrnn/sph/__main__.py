"""Entry point of `python -m jfrnn.sph`."""

import sys

from jfrnn.sph.commands import main

sys.exit(main())
