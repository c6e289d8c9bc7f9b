"""A machine cycle as the bytes of docs/frame.md: postcard's integers in an envelope of COBS with a CRC-32."""

import zlib

KIND = 3  # a frame, version 3

# steps of a value, and the largest that is carried
CURRENT_STEP_A, LARGEST_CURRENT_A = 1e-4, 1e4
RF_STEP, LARGEST_RF = 1e-9, 1e-2
POSITION_STEP_MM, LARGEST_POSITION_MM = 1e-4, 100.0
TUNE_STEP = 1e-6


def encode(frame):
    """The frame on the wire, with the zero byte at its end."""
    body = bytearray()
    for number in (frame["epoch"], frame["sequence"], frame["time_us"], frame["cycle_time_us"]):
        body += varint(number)
    body += currents(frame["corrector"])
    body += signed(steps(frame["dipole"] or 0.0, CURRENT_STEP_A))
    body += currents(frame["supply"])
    body += signed(steps(frame["rf_offset"], RF_STEP))
    readings = frame["reading_mm"]
    body += varint(len(readings))
    for mm in readings:
        body += signed(0 if mm is None else steps(mm, POSITION_STEP_MM))
    for tune in frame["tune"]:
        body += b"\x00" if tune is None else b"\x01" + signed(steps(tune, TUNE_STEP))
    body += b"\x00" if frame.get("intensity") is None else b"\x01" + signed(steps(frame["intensity"], 1e6))
    words = valid(readings)
    body += varint(len(words))
    for word in words:
        body += varint(word)
    packet = bytes([KIND]) + len(body).to_bytes(2, "little") + body
    return cobs(packet + zlib.crc32(packet).to_bytes(4, "little")) + b"\x00"


def steps(value, step):
    return round(value / step)


def varint(number):
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def signed(number):
    return varint(2 * number if number >= 0 else -2 * number - 1)


def currents(values):
    return varint(len(values)) + b"".join(signed(steps(value, CURRENT_STEP_A)) for value in values)


def valid(readings):
    """Words of 32 bits, one bit for each monitor that reports."""
    words = [0] * ((len(readings) + 31) // 32)
    for b, mm in enumerate(readings):
        words[b // 32] |= (mm is not None) << (b % 32)
    return words


def cobs(data):
    """Source: S. Cheshire and M. Baker, IEEE/ACM Trans. Netw. 7 (1999) 159."""
    out, block = bytearray(), bytearray()
    for byte in data:
        if byte:
            block.append(byte)
        if not byte or len(block) == 254:
            out += bytes([len(block) + 1]) + block
            block.clear()
    return bytes(out + bytes([len(block) + 1]) + block)
