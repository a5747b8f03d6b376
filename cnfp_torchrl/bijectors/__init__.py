"""Bijections from base samples to allowed actions, with exact log-determinants."""

from cnfp_torchrl.bijectors.bijector import Bijector, Stages, has_latent
from cnfp_torchrl.bijectors.chain import SquashChain
from cnfp_torchrl.bijectors.exact_squash import ExactSquash, GaugeSquash
from cnfp_torchrl.bijectors.projection import NoDensityError, Projection
from cnfp_torchrl.bijectors.radial_squash import RadialSquash
from cnfp_torchrl.bijectors.recession import Recession, require_scale
from cnfp_torchrl.bijectors.retraction import Retraction
from cnfp_torchrl.bijectors.shell_squash import ShellSquash
from cnfp_torchrl.bijectors.soft_retraction import (
    SHARPNESS,
    SoftRetraction,
    SoftSquash,
    require_sharpness,
)
from cnfp_torchrl.bijectors.squashes import BallSquash, BoxSquash, EllipsoidSquash, paper_squash
from cnfp_torchrl.bijectors.well_inside import reach, well_inside

__all__ = [
    "SHARPNESS",
    "BallSquash",
    "Bijector",
    "BoxSquash",
    "EllipsoidSquash",
    "ExactSquash",
    "GaugeSquash",
    "NoDensityError",
    "Projection",
    "RadialSquash",
    "Recession",
    "Retraction",
    "ShellSquash",
    "SoftRetraction",
    "SoftSquash",
    "SquashChain",
    "Stages",
    "has_latent",
    "paper_squash",
    "reach",
    "require_scale",
    "require_sharpness",
    "well_inside",
]
