"""MJCF texts of dm_control's models and entities."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any, Final

from dual_ur10.errors import SettingsError

_OF_A_SCENE: Final = ("option", "sensor", "size", "statistic", "visual")


def is_dm_mjcf(value: object) -> bool:
    """Check whether a value is a `dm_control.mjcf.RootElement`, or an entity of `dm_control.composer`."""
    return hasattr(getattr(value, "mjcf_model", value), "to_xml_string")


def text_of(value: Any, name: str) -> str:
    """Return the text of a model or entity, as a prop takes it.

    Sections that concern a scene or dm_control's observations are left out. What stands directly in the worldbody, as
    in an entity, becomes one free body.

    Args:
        value: For which `is_dm_mjcf` holds.
        name: Name of the prop, for messages.

    Raises:
        SettingsError: It needs files, which a text cannot hold.
    """
    model = getattr(value, "mjcf_model", value)
    files = sorted(model.get_assets())
    if files:
        raise SettingsError(
            f"the model of the prop {name!r} needs {len(files)} files, such as {files[0]}: use primitive geoms, or an "
            "MJCF text whose meshes have vertices"
        )
    root = ET.fromstring(model.to_xml_string())
    for section in [each for each in root if each.tag in _OF_A_SCENE]:
        root.remove(section)
    world = root.find("worldbody")
    parts = [] if world is None else list(world)
    if world is not None and [each.tag for each in parts] != ["body"]:
        body = ET.Element("body")
        ET.SubElement(body, "freejoint")
        body.extend(parts)
        for each in parts:
            world.remove(each)
        world.append(body)
    return ET.tostring(root, encoding="unicode")
