"""Small ONNX files. The format is protobuf: each field is its number, its length and its bytes."""


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value % 128 + 128]), value // 128
    return out + bytes([value])


def message(*fields):
    """A protobuf message of (number, value): whole numbers, text, or the bytes of a message inside."""
    out = b""
    for number, value in fields:
        if isinstance(value, int):
            out += varint(8 * number) + varint(value)
        else:
            data = value.encode() if isinstance(value, str) else value
            out += varint(8 * number + 2) + varint(len(data)) + data
    return out


def numbers(name, *shape, kind=1):
    """A named input or output of float32, or of another kind (7 int64, 9 bool)."""
    dims = message(*((1, message((1, n))) for n in shape))
    return message((1, name), (2, message((1, message((1, kind), (2, dims))))))


def looping_network(trips: int, *, kind: int = 1) -> bytes:
    """A Loop that hands the grid on so many times."""
    grid = (1, 5, 64, 64, 64)
    steps = [(1, message((1, f"{x}_in"), (2, f"{x}_out"), (4, "Identity"))) for x in ("go", "x")]
    ends = [(11, numbers("i", kind=7)), (11, numbers("go_in", kind=9)), (11, numbers("x_in", *grid, kind=kind))]
    ends += [(12, numbers("go_out", kind=9)), (12, numbers("x_out", *grid, kind=kind))]
    body = message((1, "body"), (6, message(*steps, (2, "body"), *ends)), (20, 5))
    loop = message((1, "trips"), (1, ""), (1, "grid"), (2, "out"), (4, "Loop"), (5, body))
    constant = message((2, 7), (8, "trips"), (9, trips.to_bytes(8, "little")))
    ends = [(11, numbers("grid", *grid, kind=kind)), (12, numbers("out", *grid, kind=kind))]
    return message((1, 8), (7, message((1, loop), (2, "g"), (5, constant), *ends)), (8, message((2, 17))))


def contact_network(channel: int = 1, *, file: str = "", inputs: int = 1) -> bytes:
    """The sigmoid of one channel of (1, 5, 64, 64, 64); `file`: the channel's number stands in that file."""
    axis = message((1, "axis"), (3, 1), (20, 2))
    pick = message((1, "grid"), (1, "channel"), (2, "picked"), (4, "Gather"), (5, axis))
    sigmoid = message((1, "picked"), (2, "contact"), (4, "Sigmoid"))
    here = [(9, channel.to_bytes(8, "little"))]
    there = [(13, message((1, "location"), (2, file))), (14, 1)]
    constant = message((2, 7), (8, "channel"), *(there if file else here))
    grids = [(11, numbers(name, 1, 5, 64, 64, 64)) for name in ("grid", "more")[:inputs]]
    parts = [(1, pick), (1, sigmoid), (2, "g"), (5, constant), *grids, (12, numbers("contact", 1, 64, 64, 64))]
    return message((1, 8), (7, message(*parts)), (8, message((2, 17))))


def expanding_network(count: int) -> bytes:
    """A network that fills so many floats before it answers with the first ones of them."""
    grid = (1, 5, 64, 64, 64)
    fill = message((1, "count"), (2, "filled"), (4, "ConstantOfShape"))
    total = message((1, "filled"), (2, "total"), (4, "ReduceSum"))
    add = message((1, "grid"), (1, "total"), (2, "out"), (4, "Add"))
    constant = message((1, 1), (2, 7), (8, "count"), (9, count.to_bytes(8, "little")))
    ends = [(11, numbers("grid", *grid)), (12, numbers("out", *grid))]
    return message(
        (1, 8), (7, message((1, fill), (1, total), (1, add), (2, "g"), (5, constant), *ends)), (8, message((2, 17)))
    )
