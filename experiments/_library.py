"""The one place where experiments take what is private to the library. All else they ask by its public names, as users do.

- `load_warp`: Warp as the library starts it, quietly and once, so that kernels of both share its settings.
- `round_capacity`: how the library rounds the slots of a row, so that lists here are as long as those that it makes itself.
- `taylor_green_velocity`, `free`, `LAYERS`: parts of scenes of `jfrnn.cases`, for answers and scenes beside them.
"""

from typing import Any

from jfrnn._engine.start import load_warp
from jfrnn._search import round_capacity
from jfrnn.cases import _fluid_flows, _fluid_free

Name = Any  # one of a few words, such as a backend, as a config or a command line gives it

taylor_green_velocity, free, LAYERS = _fluid_flows.taylor_green_velocity, _fluid_free.free, _fluid_free.LAYERS
