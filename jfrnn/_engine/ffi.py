"""What Python reads of XLA's foreign function interface (xla/ffi/api/c_api.h) before native code, which includes it, is there."""

import ctypes

_API_VERSION = (0, 1)
_METADATA = 1  # the extension that asks for the version
_INTERNAL_ERROR = 13
_INSTANTIATE = 0  # the stage of a call


class Version(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p), ("major", ctypes.c_int), ("minor", ctypes.c_int))


class Metadata(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("version", Version), ("traits", ctypes.c_uint32))


class Extension(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(Metadata)),  # of the one type that is looked at
    )


class _Failure(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


class Api(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", Version),
        ("internal", ctypes.c_void_p),
        ("fail", ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Failure))),
    )


class Text(ctypes.Structure):
    _fields_ = (("ptr", ctypes.c_void_p), ("len", ctypes.c_size_t))

    def decode(self) -> str:
        """Return it as a string of Python."""
        return ctypes.string_at(self.ptr, self.len).decode()


class Arrays(ctypes.Structure):
    """Arrays that are given, or written."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_longlong),
        ("types", ctypes.c_void_p),
        ("arrays", ctypes.c_void_p),
    )


class Attributes(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_longlong),
        ("types", ctypes.c_void_p),
        ("names", ctypes.POINTER(ctypes.POINTER(Text))),
        ("attrs", ctypes.POINTER(ctypes.POINTER(Text))),  # those that are looked at
    )


class CallFrame(ctypes.Structure):
    """The first fields of what XLA hands over with a call."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(Extension)),
        ("api", ctypes.POINTER(Api)),
        ("ctx", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("args", Arrays),
        ("rets", Arrays),
        ("attrs", Attributes),
    )

    @property
    def instantiates(self) -> bool:
        """Whether a program is being made that will call."""
        return self.stage == _INSTANTIATE

    def text(self, name: str) -> str:
        """Return a text that a program carries."""
        given = self.attrs
        named = {given.names[k].contents.decode(): given.attrs[k] for k in range(given.size)}
        return named[name].contents.decode()

    def tell_version(self) -> bool:
        """Say whether this is no call but a question for the version of the interface, and answer it."""
        if not self.extension or self.extension.contents.type != _METADATA:
            return False  # with any other extension it is a call
        version = self.extension.contents.metadata.contents.version
        version.major, version.minor = _API_VERSION
        return True

    def fail(self, message: str) -> int | None:
        """Return what makes XLA raise an error with a message."""
        return self.api.contents.fail(_Failure(ctypes.sizeof(_Failure), None, message.encode(errors="replace"), _INTERNAL_ERROR))
