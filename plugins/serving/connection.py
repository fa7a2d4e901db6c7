"""A client's connection, whose frames without content are counted as well.

The library answers pings by itself, as fast as they come, and keeps fragments of a message until the last one.
"""

from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.frames import CTRL_OPCODES, Frame

from .admission import Admission, Pace, ServerLimits

SLICE = 4096
"""Bytes that are read at once: of pings they hold 680, which take some milliseconds."""
SMALL = 1024
"""Bytes of a fragment that is counted as one without content."""
UNREAD = 2**18
"""Bytes of answers to pings that wait for a client, at most."""


class CountedConnection(ServerConnection):
    """Ends, as by the network, when its client sends too many pings or empty fragments, or reads no answers.

    So does one that is closed, but whose client leaves its socket open: the library would wait for it for ever.
    """

    def __init__(self, admission: Admission, limits: ServerLimits, *library: Any, **more: Any) -> None:
        super().__init__(*library, **more)
        self._admission = admission
        self._pace = Pace(limits.control_per_second, self.loop.time())
        self._closing, self._close_timeout = False, limits.send_timeout

    def data_received(self, data: bytes) -> None:
        """As of any connection, a slice after the other."""
        for start in range(0, len(data), SLICE):
            if self.transport.is_closing():
                return
            super().data_received(data[start : start + SLICE])
            if self.transport.get_write_buffer_size() > UNREAD:
                self._cut_off()
        if self.protocol.close_expected() and not self._closing:
            self._closing = True
            self.loop.call_later(self._close_timeout, self.transport.abort)

    def process_event(self, event: Any) -> None:
        """As of any connection."""
        super().process_event(event)
        if isinstance(event, Frame):
            idle = event.opcode in CTRL_OPCODES or (not event.fin and len(event.data) < SMALL)
            if idle and self._pace.wait(self.loop.time()):
                self._cut_off()

    def _cut_off(self) -> None:
        if not self.transport.is_closing():
            self._admission.offends(self.remote_address, self.local_address)
            self.transport.abort()
