"""The stream of a flow policy to a Rerun viewer, one picture for each step."""

try:
    import rerun  # noqa: F401
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "cnfp_torchrl.visual.stream: expected rerun-sdk to be installed; "
        "pip install 'cnfp_torchrl[rerun]'",
        name="rerun",
    ) from error

from cnfp_torchrl.visual.stream.blueprint import TRAINING_PLOTS, flow_blueprint
from cnfp_torchrl.visual.stream.flow_stream import FlowStream
from cnfp_torchrl.visual.stream.logger import RerunLogger
from cnfp_torchrl.visual.stream.sinks import Recording, open_recording
from cnfp_torchrl.visual.stream.viewers import (
    RunningViewer,
    SinkError,
    Viewer,
    ViewerWindow,
    WebViewer,
)
from cnfp_torchrl.visual.stream.watch import Watch
from cnfp_torchrl.visual.stream.ways_in import StreamHook, StreamTransform

__all__ = [
    "TRAINING_PLOTS",
    "FlowStream",
    "Recording",
    "RerunLogger",
    "RunningViewer",
    "SinkError",
    "StreamHook",
    "StreamTransform",
    "Viewer",
    "ViewerWindow",
    "Watch",
    "WebViewer",
    "flow_blueprint",
    "open_recording",
]
