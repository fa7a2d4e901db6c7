"""One artifact for many robots that ask at once: copies on a Ray cluster behind one server with a lock.

Whoever is outside of this package imports it from here.
"""

from .copies import LOCAL, FleetSettings, ray_copies
from .openpi import OpenPiServer
from .server import FleetServer, Plans

__all__ = ["LOCAL", "FleetServer", "FleetSettings", "OpenPiServer", "Plans", "ray_copies"]
