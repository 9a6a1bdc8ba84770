"""gymnasium-robotics' notice about an environment that nobody here uses."""

from __future__ import annotations

__all__ = ["drop_farama_notice"]


def drop_farama_notice() -> None:
    """Drop gymnasium-robotics' import-time notice about the Adroit hand; we use Fetch.

    It is printed, not logged, while ``gymnasium_robotics`` is imported.
    """
    try:
        import farama_notifications as farama
    except ImportError:
        return
    notice = getattr(farama, "GYMNASIUM_ROBOTICS_ADROIT_WARNING", None)
    versions = farama.notifications.get("gymnasium_robotics", {})
    for version in [version for version, text in versions.items() if text == notice]:
        del versions[version]
