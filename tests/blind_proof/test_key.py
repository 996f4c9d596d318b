import json

from examples.blind_proof.key import Key, KeyEffect, KeyParameter, KeyRival, canonical, digest


def example_key(name="a"):
    rival = KeyRival("driver_offset", ("aux_1",), 4.0)
    parameter = KeyParameter("offset_change", [1.0, 2.0, 3.0], "µT", True)
    effect = KeyEffect("hard_iron_step", "", (), "", 4.0, 1.0, (parameter,), 20.0, 15.0, rival, (rival,))
    return Key(name, "single", "norm", (effect,), {"kind": "white"}, {}, (1,), (), {}, {}, 50.0, 0.5, ("aux_1",))


def test_the_hash_depends_on_the_content():
    assert digest(canonical([example_key()])) == digest(canonical([example_key()]))
    assert digest(canonical([example_key()])) != digest(canonical([example_key("b")]))
    assert json.loads(canonical([example_key()])) == [example_key().numbers()]


def test_digest_is_sha256():
    assert digest("abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
