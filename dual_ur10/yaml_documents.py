"""YAML that somebody else wrote."""

from __future__ import annotations

from dual_ur10.errors import MissingExtraError


def documents(text: str | bytes, extra: str, purpose: str) -> list[object]:
    """Load documents of plain mappings, lists, numbers and texts.

    Anchors with their aliases, and tags, are refused: some hundred bytes of aliases would take gigabytes. Neither ROS's
    messages nor UR's calibrations hold any.

    Args:
        text: The documents.
        extra: Extra that brings PyYAML, for the message where it is missing.
        purpose: Noun of what needs it, likewise.

    Raises:
        MissingExtraError: PyYAML is not installed.
        ValueError: The text is no YAML, or not plain.
    """
    try:
        import yaml
    except ImportError:
        raise MissingExtraError("PyYAML", extra, purpose) from None

    class Plain(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML brings no types
        def compose_node(self, parent: yaml.Node | None, index: object) -> yaml.Node | None:
            event = self.peek_event()
            for kind, name in (("anchor", event.anchor), ("tag", getattr(event, "tag", None))):
                if name is not None:
                    raise ValueError(
                        f"line {event.start_mark.line + 1} has the {kind} {name!r:.60}: write the values out, without "
                        "anchors, aliases and tags"
                    )
            return super().compose_node(parent, index)

    try:
        return list(yaml.load_all(text, Loader=Plain))
    except yaml.YAMLError as error:
        raise ValueError(error) from None
