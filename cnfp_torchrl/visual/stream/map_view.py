"""The map of point navigation: walls, stations, goal, agent, and its allowed moves in place."""

from __future__ import annotations

from array import array

import numpy as np
import rerun as rr
from tensordict import TensorDictBase

from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.visual.colors import rgb
from cnfp_torchrl.visual.outlines import Line, set_outline
from cnfp_torchrl.visual.snapshot import FlowSnapshot
from cnfp_torchrl.visual.stream import style
from cnfp_torchrl.visual.stream.entities import Entities
from cnfp_torchrl.visual.stream.outlines import RayOutlines, within
from cnfp_torchrl.visual.stream.scene import MAP, FlowScene

_LONGEST_TRAIL = 1000
_NODES = 96
_TARGETS = 160
_RECENT = 12


class MapView:
    """Log point navigation's map, once its static parts and then each step.

    Args:
        stream: where to log.
        scene: with the constraints' colors.
        layout: the map.
    """

    def __init__(self, stream: rr.RecordingStream, scene: FlowScene, layout: Layout) -> None:
        self._entities = Entities(stream, MAP)
        self._scene, self._layout = scene, layout
        self._trail = array("d")
        self._log_map()
        self._log_styles()

    def follow(self, transition: TensorDictBase) -> None:
        """Remember where the agent is, for its trail; of every step, logged or not."""
        self._trail.extend(transition["observation"][:2].tolist())
        del self._trail[: -2 * _LONGEST_TRAIL]

    def end_episode(self) -> None:
        """Forget the trail."""
        self._trail = array("d")

    def log(self, snapshot: FlowSnapshot, outlines: RayOutlines) -> None:
        """Log one step.

        Args:
            snapshot: with the executed action as sample 0.
            outlines: in the plane of the moves.
        """
        x, y, _, *goal = snapshot.state["observation"].tolist()
        place, step, wall = np.array([x, y]), self._layout.step_length, self._layout.wall
        view = ((-wall - x) / step, (wall - x) / step, (-wall - y) / step, (wall - y) / step)
        entities, sets = self._entities, snapshot.region.sets

        def placed(lines: list[Line]) -> list[Line]:
            return [place + step * line for line in lines]

        for k in range(1, len(sets)):
            boundary = outlines.of_set(k)
            dropped = [] if boundary is not None else set_outline(sets[k], view, _NODES)
            entities.lines(f"sets/{k}", placed([] if boundary is None else within(boundary, view)))
            entities.lines(f"sets_dropped/{k}", placed(dropped))
        allowed = outlines.of_intersection(range(len(sets)))
        entities.lines("allowed_moves", placed(within(allowed, view)))
        moves = step * snapshot.stages[-1].samples.numpy()
        entities.points("targets", place + moves[1 : 1 + _TARGETS])
        entities.arrow("move", place, moves[0])
        trail = np.array(self._trail).reshape(-1, 2)
        entities.lines("trail", [trail[:-_RECENT], trail[-_RECENT - 1 :]])
        entities.points("goal", [goal, goal])
        entities.points("agent", [place, place])

    def _log_map(self) -> None:
        layout, wall = self._layout, self._layout.wall
        # The first axis to the right, the second one upwards, walls at one.
        self._entities.style("", rr.Transform3D(scale=[1 / wall, -1 / wall, 1]))
        corners = [(-wall, -wall), (wall, -wall), (wall, wall), (-wall, wall), (-wall, -wall)]
        self._entities.style(
            "walls", rr.LineStrips2D([corners], colors=style.MUTED, radii=style.LINE, draw_order=9)
        )
        # Boxes have no filling: an image of one color, stretched, has.
        pixels = np.full((2, 2, 3), style.OBSTACLE, dtype=np.uint8)
        for i, (x_low, y_low, x_high, y_high) in enumerate(layout.rectangles):
            size = [(x_high - x_low) / 2, (y_high - y_low) / 2, 1]
            self._entities.style(
                f"rectangles/{i}",
                rr.Transform3D(translation=[x_low, y_low, 0], scale=size),
                rr.Image(pixels, draw_order=2),
            )
        stations = len(layout.stations)
        self._entities.style(
            "stations/zones",
            rr.Points2D(
                layout.stations,
                radii=[layout.zone_radius / wall] * stations,
                colors=style.ZONE,
                draw_order=1,
            ),
        )
        self._entities.style(
            "stations/places",
            rr.Points2D(
                layout.stations, radii=style.KNOT, colors=style.STATION_COLOR, draw_order=3
            ),
        )

    def _log_styles(self) -> None:
        scene = self._scene
        lines, points = rr.LineStrips2D.from_fields, rr.Points2D.from_fields
        goal = self._layout.goal_radius / self._layout.wall
        for name, archetype in {
            "trail": lines(colors=[style.FAINT, style.TRAIL], radii=style.LINE, draw_order=10),
            "targets": points(colors=style.SAMPLE, radii=style.THIN, draw_order=11),
            "allowed_moves": lines(colors=style.PALE, radii=style.LINE, draw_order=22),
            "goal": points(
                colors=[style.GOAL_ZONE, style.GOAL_COLOR],
                radii=[goal, style.MARK_INSIDE],
                draw_order=4,
            ),
            "move": rr.Arrows2D.from_fields(colors=style.EXECUTED, radii=style.LINE, draw_order=30),
            "agent": points(
                colors=[style.BACKGROUND, style.PALE],
                radii=[style.MARK, style.MARK_INSIDE],
                draw_order=32,
            ),
        }.items():
            self._entities.style(name, archetype)
        for k, name in enumerate(scene.constraints, start=1):
            color = rgb(scene.colors[name])
            self._entities.style(f"sets/{k}", lines(colors=color, radii=style.LINE, draw_order=20))
            self._entities.style(
                f"sets_dropped/{k}",
                lines(colors=style.dimmed(color), radii=style.THIN, draw_order=19),
            )
