"""The stream of a flow policy to a Rerun viewer, one picture for each step."""

try:
    import rerun  # noqa: F401
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "cnfp_torchrl.visual.rerun: expected rerun-sdk to be installed; "
        "pip install 'cnfp_torchrl[rerun]'",
        name="rerun",
    ) from error

from cnfp_torchrl.visual.rerun.blueprint import TRAINING_PLOTS, flow_blueprint
from cnfp_torchrl.visual.rerun.hooks import StreamHook, StreamTransform
from cnfp_torchrl.visual.rerun.logger import RerunLogger
from cnfp_torchrl.visual.rerun.recording import Recording, open_recording
from cnfp_torchrl.visual.rerun.run_stream import RunStream
from cnfp_torchrl.visual.rerun.stream import FlowStream
from cnfp_torchrl.visual.rerun.viewers import (
    RunningViewer,
    SinkError,
    Viewer,
    ViewerWindow,
    WebViewer,
)

__all__ = [
    "TRAINING_PLOTS",
    "FlowStream",
    "Recording",
    "RerunLogger",
    "RunStream",
    "RunningViewer",
    "SinkError",
    "StreamHook",
    "StreamTransform",
    "Viewer",
    "ViewerWindow",
    "WebViewer",
    "flow_blueprint",
    "open_recording",
]
