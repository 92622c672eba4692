"""What the library needs from JAX's tracing: its modes, `shard_map`, and a bound on the number of compiled programs."""

from jfrnn._tracing.arguments import (
    AnyCutoff,
    Aval,
    Backend,
    Flag,
    Flags,
    Given,
    IndexRows,
    Indices,
    Internal,
    Number,
    Numbers,
    Points,
    RadiusRule,
    Real,
    Size,
    Tree,
    as_array,
    as_dtype,
    at_once,
    gather,
    make_on_host,
    on_device,
    own_transfers,
    refuse_forks,
)
from jfrnn._tracing.flags import Packed, first_set, largest_of, pack_parts, packed_places, set_places
from jfrnn._tracing.internals import ClosedJaxpr, Jaxpr, Literal, Primitive, jaxpr_as_fun
from jfrnn._tracing.late import (
    call_apart,
    call_late,
    lower_late,
    on_platform,
    result_aval,
    unvarying_types,
    vary,
    varying_axes,
    without_mesh,
)
from jfrnn._tracing.portable import check_version, decode, encode, mesh_of_parts, name_of_version, parts_of_mesh, portable
from jfrnn._tracing.programs import compile_program
from jfrnn._tracing.ruled import ruled, still
