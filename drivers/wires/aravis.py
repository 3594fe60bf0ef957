"""A GigE or USB3 Vision camera and its stream over libaravis: what the camera driver calls, nothing else; frames come
out as arrays. Bit layouts: GigE Vision 1.2, section 27 (Mono10Packed, Mono12Packed), PFNC 2.1, section 6 (Mono10p,
Mono12p).

A `GigeDevice` owns one ArvCamera, a `GigeStream` one ArvStream. Everything blocks; a feature call up to 2.5 s when
the camera is silent (Aravis: five tries of 500 ms). Not thread-safe: one thread per device.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.framing.aravis_library import Functions, load_library
from thermostand.drivers.wires.camera_settings import BITS_PER_PIXEL, PixelFormat, frame_bytes

PACKET_SOCKET_DISABLED = 1  # ArvGvStreamOption: else root would get AF_PACKET and everyone else a UDP socket
PACKET_SIZE_ADJUSTMENT_NEVER = 0  # ArvGvPacketSizeAdjustment
BUFFER_SUCCESS = 0
BUFFER_STATUS = {
    -1: "unknown",
    BUFFER_SUCCESS: "success",
    1: "cleared",
    2: "timeout",
    3: "missing_packets",
    4: "wrong_packet_id",
    5: "size_mismatch",
    6: "filling",
    7: "aborted",
}

# Kinds of nodes that carry a float; the others with a number carry an integer.
FLOAT_KINDS = frozenset({"Float", "FloatReg", "Converter", "SwissKnife"})

# The fundamental GTypes (gtype.h: number << 2) that properties are set with.
G_TYPE_INT, G_TYPE_UINT, G_TYPE_DOUBLE = 6 << 2, 7 << 2, 15 << 2

CONTROL_LOST_CALLBACK = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)


Pixels = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class BufferInfo:
    """The head of a received buffer. `timestamp_ns`: the leader's ticks as ns, on the camera's clock."""

    status: int
    frame_id: int
    timestamp_ns: int
    width: int
    height: int


class _GValue(ctypes.Structure):
    _fields_ = (("g_type", ctypes.c_size_t), ("data", ctypes.c_uint64 * 2))


class GigeDevice:
    """One camera, opened by IP address, or by Aravis' name for it when it is a USB3 Vision one; StandError without
    libaravis, AravisError when there is no answer. is_gige: it has bootstrap registers, packets and a heartbeat.

    Opening succeeds while another client controls a GigE camera, read-only: ask `is_controller`.
    """

    def __init__(self, address: str) -> None:
        self._library = load_library()
        self._camera = self._library["arv_camera_new"](address.encode())
        self._device = self._library["arv_camera_get_device"](self._camera)  # borrowed: never unref
        self.is_gige = bool(self._library["arv_camera_is_gv_device"](self._camera))
        if self.is_gige:
            self._library["arv_camera_gv_set_stream_options"](self._camera, PACKET_SOCKET_DISABLED)
        self._callback: Any = None
        self._handler = 0

    def _call(self, function: str, *arguments: object) -> Any:
        if not self._camera:
            raise ValueError("the device is closed")
        # By name from the library's own mapping; only functions with a GError are wrapped.
        return self._library[function](self._camera, *arguments)

    def close(self) -> None:
        """Let go of the camera; up to 7.5 s when it is dead. May be called twice. Close its stream first."""
        if self._camera:
            if self._handler:
                self._library["g_signal_handler_disconnect"](self._device, self._handler)
            self._library["g_object_unref"](self._camera)  # joins the heartbeat thread: no callback after this
            self._camera = None

    def on_control_lost(self, notify: Callable[[], object]) -> None:
        """Call `notify` when control is lost, once, in Aravis' heartbeat thread: it may only set an event."""

        def lost(_device: int, _data: int) -> None:
            notify()

        self._callback = CONTROL_LOST_CALLBACK(lost)  # kept, or the signal would call freed memory
        pointer = ctypes.cast(self._callback, ctypes.c_void_p)
        self._handler = self._library["g_signal_connect_data"](self._device, b"control-lost", pointer, None, None, 0)

    def is_controller(self) -> bool:
        """Return whether we may write."""
        return not self.is_gige or bool(self._library["arv_gv_device_is_controller"](self._device))

    def kind(self, feature: str) -> str:
        """The GenICam kind of a feature ("Float", "Command", "IntReg", ...); "" when the camera has none."""
        node = self._library["arv_device_get_feature"](self._device, feature.encode())
        kind = (self._library["arv_dom_node_get_node_name"](node) or b"").decode() if node else ""
        return "" if kind == "Category" else kind

    def available(self, feature: str) -> bool:
        """Return whether the camera has the feature and offers it now."""
        if not self.kind(feature):
            return False
        node = self._library["arv_device_get_feature"](self._device, feature.encode())
        return bool(self._library["arv_gc_feature_node_is_implemented"](node)) and bool(
            self._call("arv_camera_is_feature_available", feature.encode())
        )

    def get_number(self, feature: str) -> float:
        """An Integer or Float feature."""
        if self.kind(feature) in FLOAT_KINDS:
            return float(self._call("arv_camera_get_float", feature.encode()))
        return float(self._call("arv_camera_get_integer", feature.encode()))

    def set_number(self, feature: str, value: float) -> None:
        """Write an Integer (rounded) or Float feature."""
        if self.kind(feature) in FLOAT_KINDS:
            self._call("arv_camera_set_float", feature.encode(), value)
        else:
            self._call("arv_camera_set_integer", feature.encode(), round(value))

    def bounds(self, feature: str) -> tuple[float, float]:
        """Minimum and maximum of an Integer or Float feature."""
        if self.kind(feature) in FLOAT_KINDS:
            lowest, highest = ctypes.c_double(), ctypes.c_double()
            name = "arv_camera_get_float_bounds"
        else:
            lowest, highest = ctypes.c_int64(), ctypes.c_int64()
            name = "arv_camera_get_integer_bounds"
        self._call(name, feature.encode(), ctypes.byref(lowest), ctypes.byref(highest))
        return float(lowest.value), float(highest.value)

    def unit(self, feature: str) -> str:
        """The unit that the camera states for an Integer or Float feature; "" when it states none."""
        node = self._library["arv_device_get_feature"](self._device, feature.encode())
        is_float = self.kind(feature) in FLOAT_KINDS
        get = "arv_gc_float_get_unit" if is_float else "arv_gc_integer_get_unit"
        return (self._library[get](node) or b"").decode(errors="replace").strip()

    def get_string(self, feature: str) -> str:
        """A String or Enumeration feature."""
        return (self._call("arv_camera_get_string", feature.encode()) or b"").decode(errors="replace")

    def set_string(self, feature: str, value: str) -> None:
        """Write a String or Enumeration feature."""
        self._call("arv_camera_set_string", feature.encode(), value.encode())

    def entries(self, feature: str) -> tuple[str, ...]:
        """Return what an Enumeration feature offers now, in the camera's order."""
        count = ctypes.c_uint()
        names = self._call("arv_camera_dup_available_enumerations_as_strings", feature.encode(), ctypes.byref(count))
        try:
            found = ctypes.cast(names, ctypes.POINTER(ctypes.c_char_p))
            return tuple((found[index] or b"").decode(errors="replace") for index in range(count.value))
        finally:
            self._library["g_free"](names)  # the array; the names are the feature's own

    def set_boolean(self, feature: str, value: bool) -> None:
        """Write a Boolean feature."""
        self._call("arv_camera_set_boolean", feature.encode(), value)

    def execute(self, feature: str) -> None:
        """Give a Command."""
        self._call("arv_camera_execute_command", feature.encode())

    def set_packet_size(self, size: int) -> None:
        """Bytes of an IP packet of the stream; Aravis will not change it afterwards."""
        self._call("arv_camera_gv_set_packet_size_adjustment", PACKET_SIZE_ADJUSTMENT_NEVER)
        self._call("arv_camera_gv_set_packet_size", size)

    def find_packet_size(self) -> int:
        """Let Aravis find the largest packet that arrives (test packets), or keep the camera's."""
        return int(self._call("arv_camera_gv_auto_packet_size"))

    def packet_size(self) -> int:
        """Bytes of an IP packet of the stream."""
        return int(self._call("arv_camera_gv_get_packet_size"))

    def start_acquisition(self) -> None:
        """Frames flow from now on."""
        self._call("arv_camera_start_acquisition")

    def stop_acquisition(self) -> None:
        """Stop taking frames."""
        self._call("arv_camera_stop_acquisition")

    def create_stream(self) -> GigeStream:
        """A new receiver; AravisError when another client controls the camera."""
        return GigeStream(self._library, self._call("arv_camera_create_stream", None, None))

    def read_register(self, address: int) -> int:
        """A 32-bit register."""
        value = ctypes.c_uint()
        self._library["arv_device_read_register"](self._device, address, ctypes.byref(value))
        return value.value

    def write_register(self, address: int, value: int) -> None:
        """Write a 32-bit register."""
        self._library["arv_device_write_register"](self._device, address, value)

    def read_text(self, address: int, size: int) -> str:
        """A NUL-padded string of the bootstrap registers; `size` is a multiple of 4."""
        memory = ctypes.create_string_buffer(size)
        self._library["arv_device_read_memory"](self._device, address, size, memory)
        return memory.raw.split(b"\0")[0].decode(errors="replace")


class GigeStream:
    """One receiver. Never stop and start acquisition on the same one: frame numbers restart at 1 and it would throw
    everything away until they pass the old last one."""

    def __init__(self, library: Functions, stream: int) -> None:
        self._library = library
        self._stream: int | None = stream

    def close(self) -> None:
        """End the receiving thread and free the buffers; may be called twice."""
        if self._stream:
            self._library["g_object_unref"](self._stream)
            self._stream = None

    def _call(self, function: str, *arguments: object) -> Any:
        if not self._stream:
            raise ValueError("the stream is closed")
        return self._library[function](self._stream, *arguments)

    def set_property(self, name: str, value: int | float, g_type: int) -> None:
        """Set a GObject property; an enumeration takes G_TYPE_INT.

        Through a GValue: the variadic g_object_set has another calling convention on some machines (arm64 macOS).
        """
        setter = {G_TYPE_INT: "g_value_set_int", G_TYPE_UINT: "g_value_set_uint", G_TYPE_DOUBLE: "g_value_set_double"}
        box = _GValue()
        self._library["g_value_init"](ctypes.byref(box), g_type)
        self._library[setter[g_type]](ctypes.byref(box), value)
        self._call("g_object_set_property", name.encode(), ctypes.byref(box))

    def add_buffer(self, size: int) -> None:
        """Give it one more buffer of `size` bytes."""
        self._call("arv_stream_push_buffer", self._library["arv_buffer_new_allocate"](size))

    def pop(self, timeout_s: float) -> int | None:
        """The oldest finished buffer, complete or not, or None after `timeout_s`; must be pushed back."""
        if timeout_s <= 0:
            return self._call("arv_stream_try_pop_buffer")
        return self._call("arv_stream_timeout_pop_buffer", round(timeout_s * 1e6))

    def push(self, buffer: int) -> None:
        """Give a popped buffer back; its pixels are gone with it."""
        self._call("arv_stream_push_buffer", buffer)

    def info(self, buffer: int) -> BufferInfo:
        """Return what the buffer says of itself; sizes are 0 unless it is complete."""
        get = self._library
        status = int(get["arv_buffer_get_status"](buffer))
        complete = status == BUFFER_SUCCESS
        return BufferInfo(
            status=status,
            frame_id=int(get["arv_buffer_get_frame_id"](buffer)),
            timestamp_ns=int(get["arv_buffer_get_timestamp"](buffer)),
            width=int(get["arv_buffer_get_image_width"](buffer)) if complete else 0,
            height=int(get["arv_buffer_get_image_height"](buffer)) if complete else 0,
        )

    def pixels(self, buffer: int, pixel_format: PixelFormat, shape: tuple[int, int]) -> Pixels | None:
        """The image of `shape` (height, width) in an array of its own, as of `unpack_pixels`; None when the buffer
        has too few bytes (chunk data may follow the pixels)."""
        size, length = frame_bytes(pixel_format, shape[0] * shape[1]), ctypes.c_size_t()
        address = self._library["arv_buffer_get_data"](buffer, ctypes.byref(length))
        if not address or length.value < size:
            return None
        pointer = ctypes.cast(address, ctypes.POINTER(ctypes.c_uint8))
        return unpack_pixels(pixel_format, np.ctypeslib.as_array(pointer, shape=(size,)).copy(), shape)

    def counters(self) -> dict[str, int]:
        """Aravis' own counters of this stream (n_completed_buffers, n_resend_requests, ...)."""
        names: list[bytes] = [
            self._call("arv_stream_get_info_name", i) for i in range(self._call("arv_stream_get_n_infos"))
        ]
        return {name.decode(): int(self._call("arv_stream_get_info_uint64_by_name", name)) for name in names}


def unpack_pixels(pixel_format: PixelFormat, data: NDArray[np.uint8], shape: tuple[int, int]) -> Pixels:
    """The image of `shape` (height, width) in `data` (frame_bytes of them): uint8, or uint16 with the camera's own
    values (0..1023 of 10 bits, 0..4095 of 12)."""
    count = shape[0] * shape[1]
    if pixel_format == "Mono8":
        return data.reshape(shape)
    if BITS_PER_PIXEL[pixel_format] == 16:
        return data.view("<u2").reshape(shape)
    if pixel_format == "Mono10p":
        return _unpack_10_bits(data, count).reshape(shape)
    return _unpack_three_bytes(pixel_format, data, count).reshape(shape)


def _unpack_three_bytes(pixel_format: PixelFormat, data: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    """Unpack two pixels in three bytes, the middle one shared."""
    first, middle, last = _group_bytes(data, 3)
    pairs = np.empty((len(first), 2), np.uint16)
    if pixel_format == "Mono12p":  # the first pixel's low bits come first
        pairs[:, 0] = first | (middle & 0xF) << 8
        pairs[:, 1] = middle >> 4 | last << 4
    elif pixel_format == "Mono12Packed":  # high bits in the outer bytes
        pairs[:, 0] = first << 4 | middle & 0xF
        pairs[:, 1] = last << 4 | middle >> 4
    else:  # Mono10Packed
        pairs[:, 0] = first << 2 | middle & 0x3
        pairs[:, 1] = last << 2 | middle >> 4 & 0x3
    return pairs.reshape(-1)[:count]


def _unpack_10_bits(data: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    """Unpack four pixels in five bytes, low bits first."""
    groups = _group_bytes(data, 5)
    pixels = np.empty((len(groups[0]), 4), np.uint16)
    for i in range(4):
        pixels[:, i] = (groups[i] >> 2 * i | groups[i + 1] << 8 - 2 * i) & 0x3FF
    return pixels.reshape(-1)[:count]


def _group_bytes(data: NDArray[np.uint8], size: int) -> NDArray[np.uint16]:
    """Shape (size, groups): the bytes of each group of `size`, the last one filled up with zeros."""
    whole = np.zeros(-(-len(data) // size) * size, np.uint16)
    whole[: len(data)] = data
    return whole.reshape(-1, size).T
