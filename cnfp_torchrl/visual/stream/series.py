"""Time series of an episode: reward, return, costs, entropy, and the battery where there is one."""

from __future__ import annotations

import rerun as rr
from tensordict import TensorDictBase

from cnfp_torchrl.tasks.point_nav.layout import BATTERY_FULL
from cnfp_torchrl.visual.colors import rgb
from cnfp_torchrl.visual.snapshot import FlowSnapshot
from cnfp_torchrl.visual.stream import components, style
from cnfp_torchrl.visual.stream.scene import METRICS, SERIES, FlowScene


class Series:
    """Sum up an episode and log it.

    Args:
        stream: where to log; names and colors are logged at once.
        scene: with the costs' names and the constraints' colors.
    """

    def __init__(self, stream: rr.RecordingStream, scene: FlowScene) -> None:
        self._stream, self._scene = stream, scene
        self._return = 0.0
        self._costs = [0.0] * len(scene.costs)
        self._reward: float | None = None
        self._log_styles()

    def follow(self, transition: TensorDictBase) -> None:
        """Add a step to the sums; of every step, logged or not."""
        reward = transition.get(("next", "reward"), None)
        self._reward = None if reward is None else float(reward.sum())
        self._return += self._reward or 0.0
        cost = transition.get(("next", "cost"), None)
        if cost is not None and self._costs:
            self._costs = [
                total + each for total, each in zip(self._costs, cost.tolist(), strict=True)
            ]

    def end_episode(self) -> None:
        """Begin the sums anew."""
        self._return, self._costs = 0.0, [0.0] * len(self._costs)

    def log(self, snapshot: FlowSnapshot) -> None:
        """Log one step that was followed.

        Args:
            snapshot: with the executed action as sample 0, which is no draw for the entropy.
        """
        if self._reward is not None:
            self._log("reward", [self._reward])
            self._log("return", [self._return])
        if self._costs:
            self._log("costs", self._costs)
        self._log("entropy", [-float(snapshot.stages[-1].log_density[1:].mean())])
        layout = self._scene.layout
        if layout is not None:
            charge = BATTERY_FULL * float(snapshot.state["observation"][2])
            self._log("battery", [charge, layout.battery_threshold])

    def _log(self, name: str, values: list[float]) -> None:
        self._stream.log(f"{SERIES}/{name}", components.scalars(values))

    def _log_styles(self) -> None:
        scene = self._scene
        styles = {
            "reward": ([style.REWARD], ["reward"]),
            "return": ([style.PALE], ["return so far"]),
            "entropy": ([style.SAMPLE], ["entropy (nats)"]),
        }
        if self._costs:
            colors = [rgb(scene.colors.get(name, "#8A8A8A")) for name in scene.costs]
            styles["costs"] = (colors, list(scene.costs))
        if scene.layout is not None:
            battery = rgb(scene.colors.get("battery", "#8A8A8A"))
            styles["battery"] = ([battery, style.MUTED], ["battery", "threshold"])
        for name, (colors, names) in styles.items():
            self._stream.log(
                f"{SERIES}/{name}",
                rr.SeriesLines(colors=colors, names=names, widths=[2.0] * len(names)),
                static=True,
            )
        for name, color in scene.colors.items():
            for metric in (f"violations/{name}", f"train/lambda_{name}"):
                line = rr.SeriesLines(colors=rgb(color), names=name)
                self._stream.log(
                    rr.new_entity_path([METRICS, *metric.split("/")]), line, static=True
                )
