"""Geometry: the exact pair test, cutoffs, periodic boxes, cells, particle orders, batches, argument checks and status bits."""

from jfrnn._geometry.batch import Batch, has_box, rank_systems
from jfrnn._geometry.box import Box, round_box
from jfrnn._geometry.box_cells import box_runs, most_cells, passes_of, sort_into_boxes
from jfrnn._geometry.cell_line import FINE, Cells, Sorting, line_runs, sort_along_line, sort_queries
from jfrnn._geometry.cells import CellAxes, cell_edge, open_axes, ordered_bits
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
from jfrnn._geometry.excluded_images import ExcludedCodes, exclude_in_lattice, exclude_in_space
from jfrnn._geometry.exclusions import Exclusions, check_exclusions, pairs_of_rows
from jfrnn._geometry.far import FAR, FAR_BITS, FAR_STEP
from jfrnn._geometry.floats import compensated_sum, rounded_product, rounded_scaled, rounded_sum
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
    check_is_known,
    check_kind,
    check_positions,
    check_radii,
    check_size,
    check_skin,
    check_slack,
    check_species,
    check_table,
    largest_known,
)
from jfrnn._geometry.integers import GUARDS, carry_limbs, fields_of, full_count, limb_bits, limb_sign, limbs_of
from jfrnn._geometry.lattice import (
    Lattice,
    Near,
    bring_near,
    forward_shifts,
    fractions_of,
    given_shifts,
    is_valid,
    make_lattice,
    nearest_shifts,
    shift_pairs,
    translation,
)
from jfrnn._geometry.marks import ROWS_ARE_WHOLE, are_finite, are_whole, good_rows, mark_rows, one_or_nan
from jfrnn._geometry.meshes import merge_vertices
from jfrnn._geometry.motion import box_change, motion_of, turns_between
from jfrnn._geometry.octaves import Part, octaves_of, parts_of
from jfrnn._geometry.order import hilbert_order, sort_order
from jfrnn._geometry.status import NeighborOverflowError, Status, known_status, names_of_bits, pairs_and_status, shape_of, tell
from jfrnn._geometry.tree_order import CLASSES, order_for_tree
from jfrnn._geometry.wrapping import NOT_FINITE, TOO_FAR, Wrapped, bound_wrapping, unpack_turns, wrap
