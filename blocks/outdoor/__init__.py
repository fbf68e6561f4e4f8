"""Outdoors: six sensors on a vehicle with clocks of their own, fused twice, by a Gaussian and by particles.

`flight` says which sensors there are and how good, and where a filter starts. `belief` is an error-state
Kalman filter that remembers where the last picture was taken; `cloud` is a Rao-Blackwellized particle filter
on the same sensors, with the same knowledge, so that the two can be compared, and `corrections` what each
sensor does to it. `layout` says where the parts of their states stand. `errors` judges navigation by the
path of an antenna, and by directions.
"""

from __future__ import annotations

from flowgraph.blocks.outdoor.belief import (
    BIASED,
    FLOW,
    OUTDOOR,
    FieldObserver,
    PositionObserver,
    clone_crossing,
    clone_transition,
    flow_vector,
    new_picture,
    observe_distance,
    observe_flow,
    outdoor_navigation,
    outdoor_pose,
    outdoor_space,
    outdoor_steps,
    picture_cross,
    picture_taken,
    predict_clone,
    start_outdoor,
)
from flowgraph.blocks.outdoor.cloud import (
    ACCELEROMETER_BIAS,
    GYRO_BIAS,
    MOVED,
    POSITION,
    TURN,
    VELOCITY,
    as_cloud,
    cloud_biases,
    outdoor_belief,
    predict_outdoor,
    shifted,
    start_outdoor_cloud,
    take_outdoor_ancestors,
    take_picture,
    turned,
)
from flowgraph.blocks.outdoor.corrections import (
    correct_distance,
    correct_field,
    correct_flow,
    correct_position,
)
from flowgraph.blocks.outdoor.errors import antenna_errors, at_antenna, directed_errors
from flowgraph.blocks.outdoor.flight import (
    AIDS,
    STREAMS,
    OutdoorSensors,
    OutdoorStart,
    attitude_of_two,
    outdoor_flight,
    without_gaps,
)
from flowgraph.blocks.outdoor.layout import Layout, belief_layout, particle_layout
from flowgraph.blocks.outdoor.recording import outdoor_recording
from flowgraph.blocks.outdoor.tracks import as_geojson, as_gpx, as_kml, as_table, track_files

__all__ = [
    "Layout",
    "belief_layout",
    "particle_layout",
    "ACCELEROMETER_BIAS",
    "BIASED",
    "GYRO_BIAS",
    "cloud_biases",
    "outdoor_navigation",
    "outdoor_space",
    "shifted",
    "track_files",
    "as_table",
    "as_kml",
    "as_gpx",
    "as_geojson",
    "outdoor_recording",
    "AIDS",
    "picture_taken",
    "clone_transition",
    "turned",
    "VELOCITY",
    "TURN",
    "POSITION",
    "MOVED",
    "clone_crossing",
    "outdoor_steps",
    "picture_cross",
    "STREAMS",
    "OutdoorSensors",
    "OutdoorStart",
    "attitude_of_two",
    "outdoor_flight",
    "without_gaps",
    "FLOW",
    "FieldObserver",
    "OUTDOOR",
    "PositionObserver",
    "flow_vector",
    "new_picture",
    "observe_distance",
    "observe_flow",
    "outdoor_pose",
    "predict_clone",
    "start_outdoor",
    "as_cloud",
    "correct_distance",
    "correct_field",
    "correct_flow",
    "correct_position",
    "outdoor_belief",
    "predict_outdoor",
    "start_outdoor_cloud",
    "take_outdoor_ancestors",
    "take_picture",
    "antenna_errors",
    "at_antenna",
    "directed_errors",
]
