"""The ASAM schemas, as ``asam-qc-openscenarioxml`` carries them, and checking against them."""

from __future__ import annotations

from functools import cache
from typing import Any

from sumo_adv.errors import SumoAdvError

VERSION = "1.2.0"


def check_openscenario(text: str) -> None:
    """Nothing, if the document is valid against ASAM OpenSCENARIO 1.2.

    Raises SumoAdvError: the document is not valid (a fault of ours).
    """
    from lxml import etree

    schema = _schema()
    if not schema.validate(etree.fromstring(text.encode())):
        first = schema.error_log[0]
        raise SumoAdvError(
            f"The OpenSCENARIO made from this run is not valid (line {first.line}: {first.message}); please report it."
        )


@cache
def _schema() -> Any:
    from importlib.resources import files

    from lxml import etree

    file = files("qc_openscenario") / "schema" / VERSION / "OpenSCENARIO.xsd"
    return etree.XMLSchema(etree.fromstring(file.read_bytes()))
