"""Segmentation models for masks, on stubs: a net of one operation in ONNX's format, and a SAM 2 that cuts by colour."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from p2gs.data.capture.auto_masks import segmented
from p2gs.data.capture.segmenters import DEVIATION, MEAN, frame_of, net_segmenter, segmenter_of
from p2gs.types import UserError


def scene():
    """A red disc (the object) on grey with a red stripe far from it; what the splat says: a coarse square on it."""
    image = np.full((120, 160, 3), 90, np.uint8)
    y, x = np.mgrid[:120, :160]
    disc = (y - 60) ** 2 + (x - 70) ** 2 < 30**2
    image[disc | (x > 150)] = (220, 30, 30)
    asked = (abs(y - 60) < 24) & (abs(x - 70) < 24)
    return image, disc, asked


def overlap(a, b) -> float:
    return (a & b).sum() / (a | b).sum()


def record(number: int, payload: bytes | int) -> bytes:
    """A field of a protocol buffer: a number, or bytes with their length."""

    def varint(value: int) -> bytes:
        out = b""
        while value > 127:
            out, value = out + bytes([value & 127 | 128]), value >> 7
        return out + bytes([value])

    if isinstance(payload, int):
        return varint(number << 3) + varint(payload)
    return varint(number << 3 | 2) + varint(len(payload)) + payload


def red_net() -> bytes:
    """An ONNX model: of the picture [1, 3, H, W] what is red against green, weighted as a convolution of one pixel."""

    def tensor(name: bytes, *shape: bytes | int) -> bytes:
        axes = b"".join(record(1, record(2, n) if isinstance(n, bytes) else record(1, n)) for n in shape)
        return record(1, name) + record(2, record(1, record(1, 1) + record(2, axes)))

    weight = b"".join(record(1, n) for n in (1, 3, 1, 1)) + record(2, 1) + record(8, b"w")
    weight += record(9, np.array([1, -1, 0], np.float32).tobytes())
    node = record(1, b"x") + record(1, b"w") + record(2, b"y") + record(4, b"Conv")
    graph = record(1, node) + record(2, b"red") + record(5, weight)
    graph += record(11, tensor(b"x", 1, 3, b"h", b"w")) + record(12, tensor(b"y", 1, 1, b"h", b"w"))
    return record(1, 8) + record(7, graph) + record(8, record(2, 13))


def test_a_frame_around_what_is_asked():
    asked = np.zeros((20, 30), bool)
    asked[5:9, 10:20] = True
    assert frame_of(asked, 0.0) == (slice(5, 9), slice(10, 20))
    assert frame_of(asked, 0.5) == (slice(1, 13), slice(6, 24))
    assert frame_of(asked, 9.0) == (slice(0, 20), slice(0, 30))


def test_a_net_in_a_file_finds_the_object_beside_what_it_is_asked_for(tmp_path):
    pytest.importorskip("onnxruntime")
    (tmp_path / "red.onnx").write_bytes(red_net())
    image, disc, asked = scene()
    found = segmenter_of(str(tmp_path / "red.onnx"))(image, asked)
    assert overlap(found, disc) > 0.97  # and not the stripe
    (tmp_path / "none.onnx").write_bytes(b"no model")
    with pytest.raises(UserError, match="none.onnx: onnxruntime cannot read it"):
        segmenter_of(str(tmp_path / "none.onnx"))


@pytest.mark.parametrize("logits", [True, False])
def test_maps_of_shares_and_of_logits(logits):
    class Session:
        def get_inputs(self):
            return [SimpleNamespace(name="x", shape=[1, 3, 64, 64])]

        def run(self, wanted, feed):
            picture = feed["x"][0].transpose(1, 2, 0) * DEVIATION + MEAN
            assert picture.shape == (64, 64, 3) and picture.min() > -0.01 and picture.max() < 1.01
            red = (picture[..., 0] > 0.6).astype(np.float32)
            return [(8 * red - 4 if logits else red)[None, None]]

    image, disc, asked = scene()
    assert overlap(net_segmenter(Session())(image, asked), disc) > 0.93


def test_a_net_of_another_kind_is_told():
    session = SimpleNamespace(get_inputs=lambda: [SimpleNamespace(name="tokens", shape=[1, 77])])
    with pytest.raises(ValueError, match="tokens is .* expected a picture"):
        net_segmenter(session)


def test_sam2_is_asked_with_the_frame(tmp_path, monkeypatch):
    image, disc, asked = scene()
    seen = {}

    class Predictor:
        def __init__(self, model):
            assert model == ("config.yaml", str(tmp_path / "sam.pt"), "cpu")

        def set_image(self, picture):
            self.picture = picture

        def predict(self, box, multimask_output):
            seen["box"] = box.tolist()
            return (self.picture[..., 0] > 150)[None].astype(np.float32), None, None

    builder, predictor = ModuleType("sam2.build_sam"), ModuleType("sam2.sam2_image_predictor")
    builder.build_sam2 = lambda config, checkpoint, device: (config, checkpoint, device)
    predictor.SAM2ImagePredictor = Predictor
    for name, module in (("sam2", ModuleType("sam2")), ("sam2.build_sam", builder)):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "sam2.sam2_image_predictor", predictor)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    (tmp_path / "sam.pt").touch()
    segmenter = segmenter_of(f"sam2:config.yaml:{tmp_path / 'sam.pt'}")
    assert (segmenter(image, asked) & disc).sum() == disc.sum()
    assert seen["box"] == [47.0, 37.0, 94.0, 84.0]
    # what lies outside the hull goes; another thing than the splat shows is not believed
    found = segmented(segmenter, image, asked.astype(float), disc)
    assert found is not None and overlap(found, disc) == 1
    assert segmented(lambda i, a: ~disc, image, asked.astype(float), np.ones_like(disc)) is None


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("model.pth", "expected FILE.onnx or sam2:CONFIG:CHECKPOINT"),
        ("no.onnx", "no such file"),
        ("sam2:config.yaml", "expected sam2:CONFIG:CHECKPOINT"),
        ("sam2:config.yaml:no.pt", "there is no file no.pt"),
    ],
)
def test_what_cannot_be_a_model_is_told(name, told):
    with pytest.raises(UserError, match=told):
        segmenter_of(name)
