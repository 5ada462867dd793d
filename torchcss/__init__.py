"""torchcss: articulated tracking from one camera that keeps every explanation.

Give it a video of an articulated body, a camera and a rough start; it returns, per frame, a mixture
of poses with covariances and weights (covariance scaled sampling, Sminchisescu and Triggs, IJRR
2003). Start with `load_body`, `track_video` and `load_track`.
"""

from torchcss.app.smooth import smooth
from torchcss.app.track import TrackOptions, resume, track_video
from torchcss.app.v01 import (
    export_track,
    smooth_file,
    smooth_track,
    smooth_video,
    track_frames,
)
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.initialise.fit import initialise
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.result import Initialisation
from torchcss.initialise.view import CameraView
from torchcss.io.cameras import read_camera, read_cameras
from torchcss.io.export import export
from torchcss.io.keypoints.read import read_keypoints
from torchcss.io.motion.positions import read_motion_capture
from torchcss.io.run import Run
from torchcss.io.tracks import Track, load_track
from torchcss.io.view_files import ViewFiles
from torchcss.solve.inverse_kinematics import Solutions, inverse_kinematics
from torchcss.studies.evaluation import Evaluation, evaluate
from torchcss.tracking.batch import track_batch
from torchcss.tracking.session import Observation, Posterior, SessionState, TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

__all__ = [
    "BodyModel",
    "Camera",
    "CameraView",
    "Evaluation",
    "Initialisation",
    "InitialiseOptions",
    "Keypoints",
    "Observation",
    "Posterior",
    "Run",
    "SessionState",
    "Settings",
    "Solutions",
    "Track",
    "TrackOptions",
    "TrackingSession",
    "ViewFiles",
    "evaluate",
    "export",
    "export_track",
    "initialise",
    "inverse_kinematics",
    "load_body",
    "load_track",
    "read_camera",
    "read_cameras",
    "read_keypoints",
    "read_motion_capture",
    "resume",
    "smooth",
    "smooth_file",
    "smooth_track",
    "smooth_video",
    "track_batch",
    "track_frames",
    "track_video",
]
