"""RoM-Nav: mapless multi-floor humanoid navigation, learned first on a reduced-order model."""

__version__ = "0.1.0"
