"""Geometry: rotations, angles, curved states, many small vectors at once, and places on the Earth.

A filter of poses is mostly about attitudes, and an attitude is no vector. `rotations` has the quaternions
that all of this library uses: Hamilton, scalar first, body to world. `euler` goes to and from three angles,
in two conventions. `manifold` declares once which parts of a state are angles or quaternions, so that a
filter can move it, subtract it and average it without knowing more; `groups` adds rigid motions to such
parts, `tangent` linearises a function on such a space, and `views` gives functions of a state its parts by
name. `lanes` does the same maths for n particles side by side, with n as the last axis, and is used by its
module name; `geodetic` turns latitude, longitude and height into metres, with NumPy. All others take their
array namespace as `xp`, so they run on NumPy arrays and in a block.
"""

from __future__ import annotations

from flowgraph.blocks.geometry import lanes
from flowgraph.blocks.geometry.euler import (
    NEAR,
    ORDERS,
    angles_from_matrix,
    angles_from_quaternion,
    body_rate_matrix,
    inverse_rate_jacobian,
    inverse_rate_matrix,
    matrix_from_angles,
    need_order,
    quaternion_from_angles,
    singular_cosine,
    world_rate_matrix,
    wrapped,
)
from flowgraph.blocks.geometry.geodetic import (
    FLATTENING,
    SEMI_MAJOR_AXIS,
    as_geodetic,
    as_position,
    from_enu,
    to_earth,
    to_enu,
)
from flowgraph.blocks.geometry.groups import SE, SE_2, SO, swept, turned_by
from flowgraph.blocks.geometry.manifold import Part, Quaternion, StateSpace, angle, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import (
    between_vectors,
    conjugate,
    from_rotation_vector,
    geodesic_angle,
    level,
    multiply,
    normalize,
    parted,
    right_product,
    rotate,
    sinc,
    skew,
    slerp,
    tilt_and_heading,
    to_matrix,
    to_rotation_vector,
    world_error,
)
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.geometry.views import View, array_of, joined, stacked_parts

__all__ = [
    "to_earth",
    "multiply",
    "right_product",
    "conjugate",
    "normalize",
    "parted",
    "from_rotation_vector",
    "to_rotation_vector",
    "to_matrix",
    "rotate",
    "sinc",
    "skew",
    "between_vectors",
    "level",
    "geodesic_angle",
    "tilt_and_heading",
    "world_error",
    "slerp",
    "NEAR",
    "ORDERS",
    "angles_from_matrix",
    "angles_from_quaternion",
    "body_rate_matrix",
    "inverse_rate_jacobian",
    "inverse_rate_matrix",
    "matrix_from_angles",
    "need_order",
    "quaternion_from_angles",
    "singular_cosine",
    "world_rate_matrix",
    "wrapped",
    "Part",
    "Quaternion",
    "StateSpace",
    "angle",
    "euclidean",
    "quaternion",
    "SO",
    "SE",
    "SE_2",
    "swept",
    "turned_by",
    "linearised",
    "View",
    "array_of",
    "joined",
    "stacked_parts",
    "SEMI_MAJOR_AXIS",
    "FLATTENING",
    "as_geodetic",
    "as_position",
    "from_enu",
    "to_enu",
    "lanes",
]
