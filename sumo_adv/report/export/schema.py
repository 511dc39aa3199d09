"""The ASAM schemas, as ``asam-qc-openscenarioxml`` carries them, and checking against them."""

from __future__ import annotations

from functools import cache
from typing import Any

from sumo_adv.errors import SumoAdvError, UsageError

VERSION = "1.2.0"


def check_openscenario(text: str) -> None:
    """Nothing, if the document is valid against ASAM OpenSCENARIO 1.2.

    Raises:
        UsageError: the schema is not installed.
        SumoAdvError: the document is not valid (a fault of ours).
    """
    from lxml import etree

    schema = _schema()
    if not schema.validate(etree.fromstring(text.encode())):
        first = schema.error_log[0]
        raise SumoAdvError(
            f"The OpenSCENARIO made from this run is not valid (line {first.line}: {first.message}); please report it."
        )


def need_schema() -> None:
    """Raise UsageError, saying what to install, if the schema is not there."""
    _schema()


@cache
def _schema() -> Any:
    from importlib.resources import files

    try:
        from lxml import etree

        file = files("qc_openscenario") / "schema" / VERSION / "OpenSCENARIO.xsd"
        return etree.XMLSchema(etree.fromstring(file.read_bytes()))
    except ImportError as error:
        raise UsageError(
            "ASAM's schema, which OpenSCENARIO files are checked against, is missing: pip install 'sumo-adv[export]'."
        ) from error
