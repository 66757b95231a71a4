"""Single messages of the wire format, those of a small recorded fleet and damaged ones."""
import struct
import zlib

import numpy as np
import v2vloc

from data_set import refuses
from fleet import FRAMES


def header(kind: int, cav: bytes, metadata: bytes) -> bytes:
    """A message without a body, as the reference of the wire format describes it."""
    fields = struct.pack("<4sHBB32sQQQQQII", b"V2VL", 7, kind, len(cav), cav, 7, 3, 100_000_000, 0, 0, len(metadata),
                         zlib.crc32(metadata))
    return fields + struct.pack("<I", zlib.crc32(fields)) + metadata


#: Pace of four of five sweeps of 0.1 s from 0.5 s on: two integers in bincode's variable length (251: 16 bits, 252: 32,
#: 253: 64), and two bytes.
PACE = header(14, b"1000", b"\xfc" + struct.pack("<I", 100_000_000) + b"\xfc" + struct.pack("<I", 500_000_000) + b"\x04\x05")


def test_a_message_is_decoded_by_kind_and_by_key(run):
    for name in ("pace", "v2v/fleet/1000/pace"):
        message = v2vloc.decode(name, PACE)
        assert (message.kind, message.cav, message.sequence, message.capture_time_ns) == ("pace", "1000", 3, 100_000_000)
        assert message.payload == {"period_nanos": 100_000_000, "phase_nanos": 500_000_000, "computed": 4, "of": 5}, message.payload
        assert message.wire_bytes == len(PACE) and (message.key is None) == ("/" not in name)


def test_bad_messages_are_named(run):
    damaged = PACE[:-1] + b"\x01"
    cases = [
        ("pace", b"", "message has 0 bytes"),
        ("pace", damaged, "payload checksum"),
        ("pace", b"X" + PACE[1:], "starts with"),
        ("bev", PACE, "message is of kind pace, expected bev"),
        ("v2v/fleet/1000/pose", PACE, "message is of kind pace, expected pose"),
        ("v2v/fleet/2000/pace", PACE, "names CAV 1000 as its sender, its key names CAV 2000"),
        ("sonar", PACE, "is no kind of message"),
        ("v2v/fleet/1000/sonar", PACE, "1000/sonar"),
        ("v2v/fleet/1000/detections/json", b"{}", "use json.loads"),
    ]
    for name, data, text in cases:
        refuses(lambda: v2vloc.decode(name, data), text)


def test_messages_of_a_live_fleet_have_their_payloads(run):
    assert run.live
    payloads: dict[str, list] = {}
    for message in run.messages:
        assert message.key.startswith("v2v/fleet/") and message.wire_bytes > 92, message
        payloads.setdefault(message.kind, []).append(message.payload)
    assert set(payloads) == {"lidar", "descriptor", "bev", "truth", "stats", "control"}, payloads.keys()
    points = payloads["lidar"][0]
    assert points.dtype == np.float32 and points.shape[1] == 4 and len(payloads["lidar"]) == 2 * FRAMES
    descriptor = payloads["descriptor"][0]
    assert payloads["bev"][0].features.shape == (descriptor["channels"], descriptor["grid"]["height"],
                                                 descriptor["grid"]["width"])
    truth = payloads["truth"][-1]
    assert truth["tick"] == FRAMES - 1 and len(truth["agents"]["1000"].objects) > 0
    assert payloads["stats"][-1]["ledger"] is not None
