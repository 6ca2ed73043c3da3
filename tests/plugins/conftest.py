"""The plug-ins that a file of tests is about."""

from pathlib import Path

import pytest

from omnibench.testing import load_plugin


@pytest.fixture(autouse=True, scope="module")
def plugins(request: pytest.FixtureRequest, registries_as_before_the_module: None) -> None:  # noqa: ARG001
    """Those that a module names as PLUGINS, loaded for it alone."""
    for name in getattr(request.module, "PLUGINS", ()):
        load_plugin(Path(__file__).parents[2] / "plugins" / f"{name}.py")
