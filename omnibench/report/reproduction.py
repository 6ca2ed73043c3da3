"""The section that says how to make a report's results again: command, settings, machine and config."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel

from omnibench.config import to_yaml
from omnibench.environment import Environment
from omnibench.report.blocks import Code, Details, Fact, Facts, Paragraph, Section
from omnibench.words import plural


def reproduction_section(config: BaseModel, settings: Sequence[Fact], environment: Environment) -> Section:
    """The section for an effective config, the settings that matter most, and the environment of the work."""
    facts = (
        *settings,
        Fact("Python", environment.python),
        Fact("Platform", environment.platform),
        Fact("Processor", environment.processor or "not known", plural(environment.processors, "logical processor")),
        Fact("Versions", ", ".join(f"{name} {version}" for name, version in environment.versions.items())),
    )
    return Section(
        "reproduction",
        "How to reproduce",
        (
            Paragraph("The effective config lies beside this report. From this folder:"),
            Code("omnibench compare config.yaml -o again"),
            Facts(facts),
            Details("Effective config", (Code(to_yaml(config)),)),
        ),
        about="Config, versions and machine.",
        folded=True,
    )
