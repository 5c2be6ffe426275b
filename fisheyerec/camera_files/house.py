"""The house's own format: one key a parameter, in JSON or YAML; it holds the models the house computes with."""

from __future__ import annotations

from .entries import Section, json_text, yaml_text
from .record import HOUSE_MODELS, PARAMETERS, CameraFile, Lens, other_model


def parse_house(file: Section) -> Lens:
    """The house's own format; raises ValueError if it does not hold a camera."""
    model = file.text("model")
    if model not in HOUSE_MODELS:
        raise other_model(model, HOUSE_MODELS)
    size = file.number("width"), file.number("height")
    return Lens(model, size, [file.number(name) for name in PARAMETERS[model]])


def house_text(camera: CameraFile, suffix: str) -> str:
    """The house's JSON or YAML, by suffix, exact to the last bit."""
    entries = {"model": camera.model, "width": camera.width, "height": camera.height}
    parameters = dict(zip(PARAMETERS[camera.model], camera.params, strict=True))
    return (json_text if suffix == ".json" else yaml_text)({**entries, **parameters})
