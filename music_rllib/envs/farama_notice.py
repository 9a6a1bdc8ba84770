"""Silences gymnasium-robotics' notice about an environment that this package does not use."""

from __future__ import annotations


def drop_farama_notice() -> None:
    """Removes the notice about the Adroit hand, which ``gymnasium_robotics`` prints on import."""
    try:
        import farama_notifications as farama
    except ImportError:
        return
    notice = getattr(farama, "GYMNASIUM_ROBOTICS_ADROIT_WARNING", None)
    versions = farama.notifications.get("gymnasium_robotics", {})
    for version in [version for version, text in versions.items() if text == notice]:
        del versions[version]
