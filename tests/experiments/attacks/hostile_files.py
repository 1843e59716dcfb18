"""Generators of hostile recordings and logs.

Each generator writes a file to a path. The files are small on disk. They need gigabytes of memory or minutes of
processor time if a reader trusts them. Repeated deflate blocks make the generation fast. A block that ends with a full
flush can be repeated as bytes, so a generator compresses only some megabytes.
"""

import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

MB: Final = 1 << 20
GB: Final = 1 << 30

Generator = Callable[[Path], None]


def build_repeated_deflate(head: bytes, block: bytes, count: int, tail: bytes = b"") -> bytes:
    """Return a raw deflate stream of ``head + count * block + tail``."""
    pack = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    first = pack.compress(head) + pack.flush(zlib.Z_FULL_FLUSH)
    middle = pack.compress(block) + pack.flush(zlib.Z_FULL_FLUSH)
    return first + middle * count + pack.compress(tail) + pack.flush()


def build_gzip(head: bytes, block: bytes, size: int, tail: bytes = b"") -> bytes:
    """Return gzip data of ``head``, at least ``size`` bytes of repeated ``block``, and ``tail``.

    The data consist of several gzip members with correct checksums, as written by ``cat a.gz b.gz``.
    """
    piece = block * max(1, 16 * MB // len(block))
    return gzip.compress(head) + gzip.compress(piece) * -(-size // len(piece)) + gzip.compress(tail)


def build_npy_header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    """Return the header of a .npy array."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header,
        {"descr": descr, "fortran_order": False, "shape": shape},  # type: ignore[arg-type]
    )
    return header.getvalue()


LOCAL: Final = struct.Struct("<4s5H3I2H")
CENTRAL: Final = struct.Struct("<4s6H3I5H2I")
END: Final = struct.Struct("<4s4H2IH")


def build_zip(members: Iterable[tuple[str, bytes, int, int]], index: bool = True) -> bytes:
    """Return a zip archive of members (name, packed data, unpacked size, method), with or without its index."""
    body, central = bytearray(), bytearray()
    count = 0
    for name, packed, size, method in members:
        key = name.encode()
        at = len(body)
        fields = (20, 0, method, 0, 33, _crc(packed, size, method), len(packed), min(size, 0xFFFFFFFE), len(key), 0)
        body += LOCAL.pack(b"PK\3\4", *fields) + key + packed
        central += CENTRAL.pack(b"PK\1\2", 20, *fields, 0, 0, 0, 0, at) + key
        count += 1
    if not index:
        return bytes(body)
    end = END.pack(b"PK\5\6", 0, 0, min(count, 0xFFFF), min(count, 0xFFFF), len(central), len(body), 0)
    return bytes(body + central) + end


def _crc(packed: bytes, size: int, method: int) -> int:
    """Return the checksum of a member, or 0 for a large member. Readers check it only after they have read all data."""
    if method == zipfile.ZIP_STORED:
        return zlib.crc32(packed)
    return zlib.crc32(zlib.decompress(packed, -zlib.MAX_WBITS)) if size < 64 * MB else 0


def build_deflated_member(head: bytes, zeros: int) -> tuple[bytes, int, int]:
    """Return a deflated member of ``head`` and at least ``zeros`` zero bytes: data, unpacked size, method."""
    count = -(-zeros // (16 * MB))
    return build_repeated_deflate(head, bytes(16 * MB), count), len(head) + count * 16 * MB, zipfile.ZIP_DEFLATED


# --- CSV -----------------------------------------------------------------------------------------


def csv_header_without_end(path: Path) -> None:
    """Write a single header line of 300 MB as a sparse file."""
    with path.open("wb") as file:
        file.write(b"t,gx,")
        file.truncate(300 * MB)


def csv_ten_million_columns(path: Path) -> None:
    """Write a header and a row with 10^7 columns."""
    path.write_bytes(b"t,gx" + b",c" * 10_000_000 + b"\n0,1" + b",2" * 10_000_000 + b"\n")


def csv_hundred_thousand_columns(path: Path) -> None:
    """Write a header with 10^5 different names, and rows with 10^5 columns."""
    names = ",".join(f"c{i}" for i in range(100_000))
    path.write_text(f"t,gx,{names}\n" + ("0,1" + ",2" * 100_000 + "\n") * 3)


def csv_line_without_end(path: Path) -> None:
    """Write a valid header and a single line of 300 MB as a sparse file."""
    with path.open("wb") as file:
        file.write(b"t,gx\n")
        file.truncate(300 * MB)


def gz_header_without_end(path: Path) -> None:
    """Write a single header line of 8 GB."""
    path.write_bytes(build_gzip(b"t,gx,", b"c", 8 * GB))


def gz_comments_without_end(path: Path) -> None:
    """Write 8 GB of comment lines without a header."""
    path.write_bytes(build_gzip(b"# log\n", b"# nothing\n", 8 * GB))


def gz_line_without_end(path: Path) -> None:
    """Write a valid header and a single line of 8 GB."""
    path.write_bytes(build_gzip(b"t,gx\n0,", b"1", 8 * GB))


def gz_rows_without_end(path: Path) -> None:
    """Write 8 GB of valid rows."""
    path.write_bytes(build_gzip(b"gx,gy,gz,ax,ay,az\n", b"0,0,0,0,0,0\n", 8 * GB))


def gz_noise_then_rows_without_end(path: Path) -> None:
    """Write rows that hardly compress, then 8 GB of equal rows, so that the start of the file is not typical."""
    rng = np.random.default_rng(1)
    start = "".join(f"{x!r}\n" for x in rng.normal(size=100_000).tolist())
    path.write_bytes(build_gzip(b"gx\n" + start.encode(), b"0\n", 8 * GB))


def gz_blank_lines(path: Path) -> None:
    """Write two rows and 8 GB of empty lines."""
    path.write_bytes(build_gzip(b"t,gx\n0,1\n1,2\n", b"\n", 8 * GB))


def gz_bad_lines(path: Path) -> None:
    """Write one row and 20 MB of bad lines, which fit into memory but are too many to check one by one."""
    path.write_bytes(build_gzip(b"t,gx\n0,1\n", b"x\n", 20 * MB))


def gz_long_lines(path: Path) -> None:
    """Write 8 GB of lines of 500 kB with one sample each."""
    path.write_bytes(build_gzip(b"t,gx\n", b"0,1" + b" " * 500_000 + b"\n", 8 * GB))


def gz_empty_members(path: Path) -> None:
    """Write a valid header and a million empty gzip members."""
    path.write_bytes(gzip.compress(b"t,gx\n") + gzip.compress(b"") * 1_000_000)


def gz_in_gz(path: Path) -> None:
    """Write a decompression bomb that is compressed twice."""
    path.write_bytes(gzip.compress(build_gzip(b"gx\n", b"0\n", 8 * GB)))


# --- .npz ----------------------------------------------------------------------------------------


def npz_zeros(path: Path) -> None:
    """Write a column of 10^9 zeros and a rate."""
    n = 10**9
    column = build_deflated_member(build_npy_header((n,)), 8 * n)
    path.write_bytes(
        build_zip([("gx.npy", *column), ("fs.npy", build_npy_header((1,)) + struct.pack("<d", 100.0), 136, 0)])
    )


def npz_shape_claims(path: Path) -> None:
    """Write a header that declares 10^12 values, and three values."""
    data = build_npy_header((10**12,)) + bytes(24)
    path.write_bytes(build_zip([("gx.npy", data, len(data), 0), ("t.npy", data, len(data), 0)]))


def npz_sizes_claim(path: Path) -> None:
    """Write a member of some bytes whose index and array header declare 4 GB."""
    data = build_npy_header((500_000_000,)) + bytes(24)
    packed = build_repeated_deflate(data, b"", 0)
    path.write_bytes(build_zip([("gx.npy", packed, 4_000_000_128, 8)]))


def npz_header_without_end(path: Path) -> None:
    """Write an array with a header of 3 GB."""
    head = b"\x93NUMPY\x02\x00" + struct.pack("<I", 3 * GB) + b"{'descr': '<f8'"
    pack = build_repeated_deflate(head, b" " * (16 * MB), 192)
    path.write_bytes(build_zip([("gx.npy", pack, len(head) + 3 * GB, 8)]))


def npz_two_dimensions(path: Path) -> None:
    """Write a column of shape (10^9, 1)."""
    path.write_bytes(build_zip([("gx.npy", *build_deflated_member(build_npy_header((10**9, 1)), 8 * 10**9))]))


def npz_long_strings(path: Path) -> None:
    """Write a column of ten strings of 400 MB."""
    path.write_bytes(build_zip([("gx.npy", *build_deflated_member(build_npy_header((10,), "<U100000000"), 4 * 10**9))]))


def npz_large_rate(path: Path) -> None:
    """Write a sample rate with 10^9 values."""
    data = build_npy_header((3,)) + bytes(24)
    rate = build_deflated_member(build_npy_header((10**9,)), 8 * 10**9)
    path.write_bytes(build_zip([("gx.npy", data, len(data), 0), ("fs.npy", *rate)]))


def npz_objects(path: Path) -> None:
    """Write a column of Python objects."""
    np.savez(path, t=np.arange(3.0), gx=np.array([{}, {}, {}], dtype=object))


def npz_nested(path: Path) -> None:
    """Write nested archives of zeros."""
    inner = build_zip([("gx.npy", *build_deflated_member(build_npy_header((10**9,)), 8 * 10**9))])
    for _ in range(3):
        packed = build_repeated_deflate(inner, b"", 0)
        inner = build_zip([("gx.npy", packed, len(inner), 8)])
    path.write_bytes(inner)


def npz_members(path: Path) -> None:
    """Write an index of 300 000 members."""
    path.write_bytes(build_zip((f"{i}.npy", b"", 0, 0) for i in range(300_000)))


def npz_cut_zeros(path: Path) -> None:
    """Write an archive without an index, with three members of 10^9 zeros."""
    n = 10**9
    column = build_deflated_member(build_npy_header((n,)), 8 * n)
    path.write_bytes(build_zip([("a.npy", *column), ("gx.npy", *column), ("b.npy", *column)], index=False))


def npz_cut_members(path: Path) -> None:
    """Write an archive of 20 MB without an index, with 200 000 small members."""
    data = build_npy_header((1,)) + bytes(8)
    path.write_bytes(build_zip(((f"{i}.npy", data, len(data), 0) for i in range(200_000)), index=False))


def npz_bzip2(path: Path) -> None:
    """Write zeros with a compression ratio of a million."""
    import bz2

    block = bz2.compress(bytes(45 * MB))
    path.write_bytes(build_zip([("gx.npy", bz2.compress(build_npy_header((10**9,))) + block * 170, 8 * 10**9, 12)]))


# --- Parquet and Arrow ---------------------------------------------------------------------------


def parquet_nulls(path: Path) -> None:
    """Write two billion rows of nulls."""
    import pyarrow as pa
    from pyarrow import parquet

    nulls = pa.table({"gx": pa.nulls(50_000_000, pa.float64()), "gy": pa.nulls(50_000_000, pa.null())})
    with parquet.ParquetWriter(path, nulls.schema) as file:
        for _ in range(40):
            file.write_table(nulls, row_group_size=50_000_000)


def parquet_equal_rows(path: Path) -> None:
    """Write a billion equal rows with dictionary and run-length encoding."""
    import pyarrow as pa
    from pyarrow import parquet

    zeros = pa.table({"gx": np.zeros(50_000_000)})
    with parquet.ParquetWriter(path, zeros.schema, compression="zstd") as file:
        for _ in range(20):
            file.write_table(zeros, row_group_size=50_000_000)


def parquet_columns(path: Path) -> None:
    """Write 10^5 columns."""
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table({f"c{i}": [0.0] for i in range(100_000)} | {"gx": [0.0]}), path)


def parquet_long_strings(path: Path) -> None:
    """Write a column of equal strings of 20 MB each."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table({"gx": pa.DictionaryArray.from_arrays(pa.array([0] * 400, pa.int32()), ["x" * (20 * MB)])})
    parquet.write_table(table, path, compression="zstd")


def arrow_nulls(path: Path) -> None:
    """Write batches of 10^9 rows of nulls."""
    import pyarrow as pa

    batch = pa.record_batch({"gx": pa.nulls(10**9), "gy": pa.nulls(10**9)})
    with open_ipc_writer(path, batch.schema) as writer:
        for _ in range(3):
            writer.write_batch(batch)


def arrow_zeros(path: Path) -> None:
    """Write 8 GB of zeros in compressed batches."""
    import pyarrow as pa

    batch = pa.record_batch({"gx": np.zeros(20_000_000)})
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, batch.schema, options=options) as writer:
        writer.write_batch(batch)
        head = sink.tell()
        writer.write_batch(batch)
    data = sink.getvalue()
    schema = pa.ipc.new_stream(start := io.BytesIO(), batch.schema)
    schema.close()
    begin = len(start.getvalue()) - 8
    path.write_bytes(get_magic_bytes(path) + data[:begin] + data[begin:head] * 50 + data[-8:])


def arrow_other_column(path: Path) -> None:
    """Write a few samples and a large compressed column that is no axis."""
    import pyarrow as pa

    text = pa.array([b"\0" * (64 * MB)] * 2, pa.large_binary())
    batch = pa.record_batch({"gx": np.zeros(2), "photo": text})
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, batch.schema, options=options) as writer:
        writer.write_batch(batch)
    path.write_bytes(get_magic_bytes(path) + sink.getvalue())


def arrow_buffer_claims(path: Path) -> None:
    """Write a batch whose compressed buffer decompresses to 1 GB of zeros."""
    import pyarrow as pa

    packed = pa.Codec("zstd").compress(bytes(GB), asbytes=True)
    body = struct.pack("<q", GB) + packed
    n = len(body) + 800
    one = pa.record_batch({"gx": np.frombuffer(np.random.default_rng(1).bytes(n), np.uint8)})
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, one.schema, options=options) as writer:
        writer.write_batch(one)
    data = bytearray(sink.getvalue())
    # the uncompressed size before the random bytes, which the compressed zeros replace
    at = data.rindex(struct.pack("<q", n))
    data[at : at + len(body)] = body
    path.write_bytes(get_magic_bytes(path) + data)


def arrow_run_ends(path: Path) -> None:
    """Write one run of two billion equal values."""
    import pyarrow as pa

    runs = pa.RunEndEncodedArray.from_arrays(pa.array([2**31 - 1], pa.int32()), pa.array([0.0]))
    batch = pa.record_batch({"gx": runs})
    with open_ipc_writer(path, batch.schema) as writer:
        writer.write_batch(batch)


def arrow_columns(path: Path) -> None:
    """Write 10^5 columns."""
    import pyarrow as pa

    batch = pa.record_batch({f"c{i}": [0.0] for i in range(100_000)} | {"gx": [0.0]})
    with open_ipc_writer(path, batch.schema) as writer:
        writer.write_batch(batch)


def get_magic_bytes(path: Path) -> bytes:
    """Return the first bytes of an Arrow file, or no bytes for a stream."""
    return b"" if path.suffix == ".arrows" else b"ARROW1\0\0"


def open_ipc_writer(path: Path, schema: Any) -> Any:
    """Return a writer of an Arrow file or stream."""
    import pyarrow as pa

    return (pa.ipc.new_stream if path.suffix == ".arrows" else pa.ipc.new_file)(str(path), schema)


# --- folders -------------------------------------------------------------------------------------


def folder_of_bombs(path: Path) -> None:
    """Write five archives of 10^9 zeros and four compressed texts of 8 GB."""
    path.mkdir()
    npz_zeros(path / "00.npz")
    data = (path / "00.npz").read_bytes()
    text = build_gzip(b"gx\n", b"0\n", 8 * GB)
    for i in range(1, 5):
        (path / f"{i:02d}.npz").write_bytes(data)
        (path / f"{i:02d}.csv.gz").write_bytes(text)


def folder_of_fitting_parts(path: Path) -> None:
    """Write 200 files of five million equal rows. Each file fits into memory, but all files together do not."""
    path.mkdir()
    (path / "000.csv.gz").write_bytes(build_gzip(b"gx,gy\n", b"0,0\n", 20 * MB))
    for i in range(1, 200):
        (path / f"{i:03d}.csv.gz").hardlink_to(path / "000.csv.gz")


# --- logs and captures ---------------------------------------------------------------------------


def log_line_without_end(path: Path) -> None:
    """Write a compressed text log with its header and one line of 8 GB."""
    path.write_bytes(build_gzip(LOG_STARTS[path.suffixes[-2]], b"0", 8 * GB))


def log_blank_lines(path: Path) -> None:
    """Write a compressed text log with its header and 8 GB of empty lines."""
    path.write_bytes(build_gzip(LOG_STARTS[path.suffixes[-2]], b"\n", 8 * GB))


LOG_STARTS: Final = {
    ".asc": b"date Mon Nov 21 10:00:00 2026\nbase hex  timestamps absolute\n",
    ".log": b"",
    ".trc": b";$FILEVERSION=2.1\n;$STARTTIME=43000.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n",
    ".csv": b"t,id_hex,data_hex\n",
}


def blf_container(path: Path) -> None:
    """Write a container that decompresses to 8 GB."""
    packed = zlib.compress(bytes(1)) and build_zlib_zeros(8 * GB)
    header = struct.pack("<4sLBBBBBBBBQQLL8H8H72x", b"LOGG", 144, *[0] * 8, 144, 144, 1, 0, *[0] * 16)
    size = 16 + 16 + len(packed)
    container = struct.pack("<4sHHLL", b"LOBJ", 16, 1, size, 10) + struct.pack("<H6xL4x", 2, 0xFFFFFFFF) + packed
    path.write_bytes(header + container + bytes(size % 4))


def blf_gz_object(path: Path) -> None:
    """Write a compressed file with one object of 3 GB of zeros."""
    header = struct.pack("<4sLBBBBBBBBQQLL8H8H72x", b"LOGG", 144, *[0] * 8, 144, 144, 1, 0, *[0] * 16)
    head = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 3 * GB, 10) + struct.pack("<H6xL4x", 0, 3 * GB)
    path.write_bytes(build_gzip(header + head, b"\0", 3 * GB))


def build_zlib_zeros(size: int) -> bytes:
    """Return zlib data of zeros with a wrong checksum at the end."""
    return b"\x78\xda" + build_repeated_deflate(b"", bytes(16 * MB), size // (16 * MB)) + bytes(4)
