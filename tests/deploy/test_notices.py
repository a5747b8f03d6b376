"""Of the exporters, two notices are left out, and nothing else."""

import copyreg
import logging
import warnings

import pytest

from cnfp_torchrl.deploy.notices import without_exporters_notices

DEPRECATED = "`isinstance(treespec, LeafSpec)` is deprecated, use something else instead."


def from_copyreg(message: str, category: type[Warning]) -> None:
    warnings.warn_explicit(message, category, copyreg.__file__, 105, "copyreg")


def test_what_says_nothing_of_the_policy_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    with without_exporters_notices():
        logger.warning("torchvision is not installed. Skipping %s", "torchvision::nms")
        from_copyreg(DEPRECATED, FutureWarning)
        logger.warning("another notice")
        with pytest.warns(UserWarning, match="another"):
            from_copyreg("another", UserWarning)
    assert [record.getMessage() for record in caplog.records] == ["another notice"]
    with pytest.warns(FutureWarning, match="deprecated"):
        from_copyreg(DEPRECATED, FutureWarning)
