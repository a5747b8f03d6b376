"""Bijections from base samples to allowed actions, with exact log-determinants."""

from cnfp_torchrl.bijectors.aligned_squash import ExactSquash
from cnfp_torchrl.bijectors.ball_squash import BallSquash
from cnfp_torchrl.bijectors.bijector import Bijector, Stages, has_latent
from cnfp_torchrl.bijectors.box_squash import BoxSquash
from cnfp_torchrl.bijectors.chain import SquashChain
from cnfp_torchrl.bijectors.ellipsoid_squash import EllipsoidSquash
from cnfp_torchrl.bijectors.gauge_squash import GaugeSquash
from cnfp_torchrl.bijectors.paper_squash import paper_squash
from cnfp_torchrl.bijectors.projection import NoDensityError, Projection
from cnfp_torchrl.bijectors.radial_squash import RadialSquash
from cnfp_torchrl.bijectors.retraction import Retraction
from cnfp_torchrl.bijectors.shell_squash import ShellSquash

__all__ = [
    "BallSquash",
    "Bijector",
    "BoxSquash",
    "EllipsoidSquash",
    "ExactSquash",
    "GaugeSquash",
    "NoDensityError",
    "Projection",
    "RadialSquash",
    "Retraction",
    "ShellSquash",
    "SquashChain",
    "Stages",
    "has_latent",
    "paper_squash",
]
