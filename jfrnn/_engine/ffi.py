"""XLA's foreign function interface (xla/ffi/api/c_api.h, version 0.1): of its structures, what is read here."""

import ctypes

_API_VERSION = (0, 1)
_METADATA = 1  # the extension that asks for the version
_INTERNAL_ERROR = 13
EXECUTE = 3  # the stage of a call that runs a kernel


class _Version(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p), ("major", ctypes.c_int), ("minor", ctypes.c_int))


class Metadata(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("version", _Version), ("traits", ctypes.c_uint32))


class Extension(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(Metadata)),  # of the one type that is looked at
    )


class Buffer(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )

    @property
    def shape(self) -> tuple[int, ...]:
        """Its size along each axis."""
        return tuple(self.dims[: self.rank])


class _Buffers(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(Buffer))),
    )


class Text(ctypes.Structure):
    _fields_ = (("start", ctypes.c_void_p), ("size", ctypes.c_size_t))

    @property
    def value(self) -> bytes:
        """Its bytes."""
        return ctypes.string_at(self.start, self.size)


class _Attributes(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("names", ctypes.POINTER(ctypes.POINTER(Text))),
        ("values", ctypes.POINTER(ctypes.POINTER(Text))),  # of those that are text
    )


class _Ask(ctypes.Structure):
    """What is asked about a call: its stream, or the number of its device; the answer comes last."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("context", ctypes.c_void_p),
        ("answer", ctypes.c_void_p),
    )


class _Failure(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


Fail = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Failure))
Get = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Ask))


class Api(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("fail", Fail),
        ("others", ctypes.c_void_p * 3),
        ("get_stream", Get),
        ("more", ctypes.c_void_p * 12),
        ("get_device", Get),
    )


class CallFrame(ctypes.Structure):
    """What XLA hands over with a call."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(Extension)),
        ("api", ctypes.POINTER(Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("inputs", _Buffers),
        ("outputs", _Buffers),
        ("attributes", _Attributes),
    )

    def buffers(self) -> list[Buffer]:
        """Return the arrays, inputs first."""
        return [part.buffers[k].contents for part in (self.inputs, self.outputs) for k in range(part.size)]

    def first_text(self) -> bytes:
        """Return the first of the attributes by name, all of which are text."""
        return self.attributes.values[0].contents.value

    def text(self, name: bytes) -> bytes:
        """Return an attribute that is text."""
        given = self.attributes
        for k in range(given.size):
            if given.names[k].contents.value == name:
                return given.values[k].contents.value
        raise LookupError(f"a call without the attribute {name.decode()!r}")

    def tell_version(self) -> bool:
        """Say whether this is no call but a question for the version of the interface, and answer it."""
        if not self.extension or self.extension.contents.type != _METADATA:
            return False  # with any other extension it is a call
        version = self.extension.contents.metadata.contents.version
        version.major, version.minor = _API_VERSION
        return True

    def stream(self) -> int:
        """Return the address of the CUDA stream of a call."""
        ask = self._ask()
        self.api.contents.get_stream(ask)
        return ask.answer or 0

    def device(self) -> int:
        """Return the number of the CUDA device of a call."""
        ask = self._ask()
        self.api.contents.get_device(ask)
        return (ask.answer or 0) & 0x7FFFFFFF

    def failure(self, message: str) -> int | None:
        """Return what makes XLA raise an error with a message."""
        return self.api.contents.fail(_Failure(ctypes.sizeof(_Failure), None, message.encode(errors="replace"), _INTERNAL_ERROR))

    def _ask(self) -> _Ask:
        return _Ask(ctypes.sizeof(_Ask), None, self.context, None)
