"""What the library needs from JAX's tracing: its modes, `shard_map`, and a bound on the number of compiled programs."""

from jfrnn._tracing.arguments import (
    AnyCutoff,
    Backend,
    Flag,
    Flags,
    IndexRows,
    Indices,
    Number,
    Numbers,
    Points,
    RadiusRule,
    Real,
    Size,
    as_array,
    default_float,
)
from jfrnn._tracing.flags import first_set, largest_of, set_places
from jfrnn._tracing.forks import refuse_forks
from jfrnn._tracing.kinds import Aval, Given, Internal, Tree
from jfrnn._tracing.late import call_late, lower_late, on_platform
from jfrnn._tracing.manual import call_apart, result_aval, unvarying_types, vary, varying_axes
from jfrnn._tracing.modes import gather, own_transfers
from jfrnn._tracing.programs import at_once, compile_program, make_on_host, on_device
