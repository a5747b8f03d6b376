"""Maps of point navigation other than the reference task's."""

from cnfp_torchrl.tasks.point_nav import Layout

NONE = Layout(rectangles=())
THREE = Layout(
    rectangles=((-0.6, -0.6, -0.2, 0.1), (0.1, -0.2, 0.6, 0.3), (-0.4, 0.4, 0.5, 0.6)),
)
MAZE = Layout(
    rectangles=(
        (-0.8, -0.7, -0.7, 0.9),
        (-0.5, -0.9, -0.4, 0.8),
        (-0.2, -0.8, -0.1, 0.9),
        (0.1, -0.5, 0.7, -0.4),
        (0.35, -0.2, 0.9, 0.9),
    ),
    stations=((-0.9, -0.9), (0.0, 0.95)),
)
