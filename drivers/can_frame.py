"""One classic CAN frame as bytes: Linux `struct can_frame`, on SocketCAN and on the hub's socket alike.

Pure; opens nothing.
"""

import struct

FRAME = struct.Struct("=IB3x8s")  # id with flag bits, payload length, padding, data: 16 bytes
FILTER = struct.Struct("=II")  # id, mask
STATISTICS = struct.Struct("=QQ")  # frames relayed, frames lost for this client

EXTENDED_FLAG = 0x80000000
REMOTE_FLAG = 0x40000000
ERROR_FLAG = 0x20000000
STANDARD_MASK = 0x7FF
