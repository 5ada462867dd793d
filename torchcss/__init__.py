"""torchcss: articulated tracking from one camera that keeps every explanation.

Give it a video of an articulated body, a camera and a rough start; it returns, per frame, a mixture
of poses with covariances and weights (covariance scaled sampling, Sminchisescu and Triggs, IJRR
2003). Start with `load_body`, `track_video` and `load_track`.
"""

from torchcss.body.model import BodyModel, load_body
from torchcss.initialise import Initialisation, initialise
from torchcss.inverse_kinematics import Solutions, inverse_kinematics
from torchcss.io.export import export_track
from torchcss.io.tracks import Track, load_track
from torchcss.pipeline import track_frames
from torchcss.settings import Settings
from torchcss.smooth import smooth_file, smooth_track
from torchcss.smooth_video import smooth_video
from torchcss.track_files import track_video
from torchcss.vision.camera import Camera

__all__ = [
    "BodyModel",
    "Camera",
    "Initialisation",
    "Settings",
    "Solutions",
    "Track",
    "export_track",
    "initialise",
    "inverse_kinematics",
    "load_body",
    "load_track",
    "smooth_file",
    "smooth_track",
    "smooth_video",
    "track_frames",
    "track_video",
]
