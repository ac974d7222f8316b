"""Tuples of arrays as arguments of kernels: one pointer, where numba would pass every field of every array by itself.

A helper that takes seventeen arrays has two hundred arguments, to be packed and unpacked wherever it is called: a sixth
of the time of compiling. As a pointer they are one, and kernels run as fast.
"""

from __future__ import annotations

from typing import Any, TypeVar

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import NativeValue, models, register_model, typeof_impl, unbox

Tuple = TypeVar("Tuple", bound=type)


class ByReference(types.Type):
    """numba's type of a NamedTuple of arrays that is passed as a pointer to its arrays."""

    def __init__(self, name: str, fields: dict[str, types.Array]) -> None:
        self.fields = fields
        super().__init__(f"{name}({', '.join(f'{field}: {array}' for field, array in fields.items())})")


@register_model(ByReference)
class _Pointer(models.OpaqueModel):
    """A pointer to a struct that lies on the stack of the entry's wrapper."""


def _struct(context: Any, typ: ByReference) -> ir.LiteralStructType:
    return ir.LiteralStructType([context.get_value_type(array) for array in typ.fields.values()])


@unbox(ByReference)
def _unbox(typ: ByReference, value: Any, c: Any) -> NativeValue:
    struct = cgutils.alloca_once(c.builder, _struct(c.context, typ))
    failed = cgutils.false_bit
    cleanups = []
    for number, array in enumerate(typ.fields.values()):
        native = c.unbox(array, c.pyapi.tuple_getitem(value, number))
        c.builder.store(native.value, cgutils.gep_inbounds(c.builder, struct, 0, number))
        failed = c.builder.or_(failed, native.is_error)
        if native.cleanup is not None:
            cleanups.append(native.cleanup)

    def clean_up() -> None:
        for clean in cleanups:
            clean()

    return NativeValue(c.builder.bitcast(struct, cgutils.voidptr_t), is_error=failed, cleanup=clean_up)


@infer_getattr
class _Fields(AttributeTemplate):
    key = ByReference

    def generic_resolve(self, typ: Any, name: str) -> Any:  # type: ignore[override]  # numba's own is no function
        return typ.fields.get(name)


@lower_getattr_generic(ByReference)
def _load_field(context: Any, builder: Any, typ: ByReference, value: Any, name: str) -> Any:
    struct = builder.bitcast(value, _struct(context, typ).as_pointer())
    array = builder.load(cgutils.gep_inbounds(builder, struct, 0, list(typ.fields).index(name)))
    return impl_ret_borrowed(context, builder, typ.fields[name], array)


def by_reference(named_tuple: Tuple) -> Tuple:
    """Class decorator for a NamedTuple of arrays: kernels take such tuples as pointers, and may not return them."""

    @typeof_impl.register(named_tuple)
    def _typeof(value: Any, context: Any) -> ByReference:
        fields = {name: typeof_impl(array, context) for name, array in value._asdict().items()}
        return ByReference(named_tuple.__name__, fields)

    return named_tuple
