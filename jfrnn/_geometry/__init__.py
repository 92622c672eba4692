"""Geometry: the exact pair test, cutoffs, periodic boxes, cells, particle orders, batches, argument checks and status bits."""

from jfrnn._geometry.batch import Batch, has_box, rank_systems
from jfrnn._geometry.box import Box, round_box
from jfrnn._geometry.box_cells import box_runs, most_cells, passes_of, sort_into_boxes
from jfrnn._geometry.cell_line import FINE, CellAxes, Cells, Sorting, cell_edge, line_runs, open_axes, sort_along_line, sort_queries
from jfrnn._geometry.curves import hilbert_decode, hilbert_encode, morton_decode, morton_encode
from jfrnn._geometry.cutoffs import (
    EXCHANGED,
    Cutoff,
    Cutoffs,
    Radii,
    are_valid,
    is_radius,
    make_cutoff,
    make_cutoffs,
    step_one_bounds,
    widen,
)
from jfrnn._geometry.exact import (
    Pair,
    Shifted,
    decide_in_integers,
    decide_in_units,
    decide_pairs,
    flat_take,
    is_pair_of,
    shift_in_given,
    squared_distance,
    take_points,
)
from jfrnn._geometry.exclusions import (
    ExcludedCodes,
    Exclusions,
    check_exclusions,
    exclude_in_lattice,
    exclude_in_space,
    pairs_of_rows,
)
from jfrnn._geometry.far import FAR, FAR_BITS, FAR_STEP
from jfrnn._geometry.floats import compensated_sum, ordered_bits, rounded_product, rounded_scaled, rounded_sum
from jfrnn._geometry.images import LARGEST_TURN, Images, box_of_list, grow_images, images_of, refuse_status
from jfrnn._geometry.inputs import (
    check_active,
    check_again,
    check_batch,
    check_box,
    check_capacity,
    check_cutoff,
    check_devices,
    check_flag,
    check_kind,
    check_positions,
    check_radii,
    check_size,
    check_skin,
    check_slack,
    check_species,
    check_table,
    check_values,
    largest_known,
)
from jfrnn._geometry.integers import GUARDS, carry_limbs, fields_of, full_count, limb_bits, limb_sign, limbs_of
from jfrnn._geometry.lattice import (
    KnownBox,
    Lattice,
    Near,
    bring_near,
    forward_shifts,
    fractions_of,
    given_shifts,
    make_lattice,
    nearest_shifts,
    plain_box,
    shift_pairs,
    sides_of,
    translation,
)
from jfrnn._geometry.meshes import merge_vertices
from jfrnn._geometry.motion import box_change, motion_of, turns_between
from jfrnn._geometry.octaves import Part, octaves_of, parts_of
from jfrnn._geometry.order import CLASSES, hilbert_order, order_for_tree, sort_order
from jfrnn._geometry.status import (
    ROWS_ARE_WHOLE,
    NeighborOverflowError,
    Status,
    are_finite,
    are_whole,
    good_rows,
    known_status,
    mark_rows,
    names_of_bits,
    pairs_and_status,
    shape_of,
    tell,
)
from jfrnn._geometry.wrapping import (
    NOT_FINITE,
    TOO_FAR,
    NearRows,
    Wrapped,
    bound_wrapping,
    find_bounding,
    find_known,
    known_box,
    unpack_turns,
    wrap,
)
