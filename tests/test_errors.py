"""Bad calls: every message names the function, the argument, what was expected and what came, on one line."""

# ruff: noqa: E501  a table is read by its columns: one bad call a line

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import fisheyerec as fr
import fisheyerec.numpy as door

H, W, h, w = 20, 24, 15, 16
CAMERA = fr.FisheyeCamera([12.0, 12, 11.5, 9.5, 0.05, 0, 0, 0], (H, W))
VIEW = fr.PinholeCamera.from_fov(90, (h, w))
IMAGE, PICTURE = torch.rand(2, 3, H, W), torch.rand(2, 3, h, w)
ARRAY = np.zeros((H, W, 3), np.uint8)
LABELS = torch.zeros(2, 1, H, W, dtype=torch.int64)
THREE = fr.FisheyeCamera(np.tile(CAMERA.params, (3, 1)), (H, W))
THREE_VIEWS = fr.PinholeCamera(np.tile(VIEW.params, (3, 1)), (h, w))
PARAMS = CAMERA.params.tolist()


def layer(image, params, **options):
    return fr.DistortionRectification(VIEW, **options)(image, params)


# The call -> its exception, the function and argument its message names, what was expected, and what came.
RECTIFY = {
    "numpy_image": (lambda: fr.rectify(ARRAY, CAMERA, VIEW), TypeError, "image as a torch.Tensor", "ndarray"),
    "no_image": (lambda: fr.rectify(None, CAMERA, VIEW), TypeError, "image as a torch.Tensor", "NoneType"),
    "image_of_3_dimensions": (lambda: fr.rectify(IMAGE[0], CAMERA, VIEW), ValueError, r"image of shape \(B, C, H, W\)", r"\(3, 20, 24\)"),
    "complex_image": (lambda: fr.rectify(IMAGE.to(torch.complex64), CAMERA, VIEW), ValueError, "image of .* real dtype", "complex64"),
    "labels_mixed": (lambda: fr.rectify(LABELS, CAMERA, VIEW), ValueError, "image of a floating dtype or uint8 for bilinear", "torch.int64"),
    "mask_mixed": (lambda: fr.rectify(LABELS.bool(), CAMERA, VIEW), ValueError, "image of a floating dtype or uint8 for bilinear", "torch.bool"),
    "float8_image": (lambda: fr.rectify(IMAGE.to(torch.float8_e4m3fn), CAMERA, VIEW), ValueError, "image of .*dtype", "float8_e4m3fn"),
    "float8_labels": (lambda: fr.rectify(IMAGE.to(torch.float8_e5m2), CAMERA, VIEW, interpolation="nearest"), ValueError, "image of .*dtype", "float8_e5m2"),
    "image_of_another_size": (lambda: fr.rectify(IMAGE[..., :-1], CAMERA, VIEW), ValueError, r"image of the size of camera, \(20, 24\)", r"\(20, 23\)"),
    "image_without_pixels": (lambda: fr.rectify(IMAGE[..., :0], CAMERA, VIEW), ValueError, "image of the size of camera", r"\(20, 0\)"),
    "camera_is_a_tensor": (lambda: fr.rectify(IMAGE, torch.tensor(PARAMS), VIEW), TypeError, "camera as a camera", "Tensor"),
    "view_is_a_number": (lambda: fr.rectify(IMAGE, CAMERA, 90), TypeError, "view as a camera", "int"),
    "cameras_do_not_match": (lambda: fr.rectify(IMAGE, THREE, VIEW), ValueError, r"camera.params of shape \(B, 8\) with B = 2 \(the image batch\)", r"\(3, 8\)"),
    "views_do_not_match": (lambda: fr.rectify(IMAGE, CAMERA, THREE_VIEWS), ValueError, r"view.params of shape \(B, 4\) with B = 2 \(the image batch\)", r"\(3, 4\)"),
    "rotations_do_not_match": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, rotation=torch.eye(3).repeat(3, 1, 1)), ValueError, r"rotation of shape \(B, 3, 3\) with B = 2", r"\(3, 3, 3\)"),
    "rotation_is_an_array": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, rotation=np.eye(3)), TypeError, "rotation as a torch.Tensor", "ndarray"),
    "rotation_is_a_list": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, rotation=np.eye(3).tolist()), TypeError, "rotation as a torch.Tensor", "list"),
    "rotation_2x2": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, rotation=torch.eye(2)), ValueError, r"rotation of shape \(3, 3\)", r"\(2, 2\)"),
    "rotation_vector": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, rotation=torch.ones(3)), ValueError, r"rotation of shape \(3, 3\)", r"\(3,\)"),
    "rotation_of_integers": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, rotation=torch.eye(3).int()), ValueError, "rotation of .* floating dtype", "int32"),
    "bicubic": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, interpolation="bicubic"), ValueError, r"interpolation in \('bilinear', 'nearest'\)", "'bicubic'"),
    "reflection": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, padding="reflection"), ValueError, r"padding in \('zeros', 'border'\)", "'reflection'"),
    "padding_is_a_number": (lambda: fr.rectify(IMAGE, CAMERA, VIEW, padding=0), ValueError, "padding in", "0"),
}  # fmt: skip

DISTORT = {
    "numpy_picture": (lambda: fr.distort(ARRAY, VIEW, CAMERA), TypeError, "picture as a torch.Tensor", "ndarray"),
    "view_and_camera_swapped": (lambda: fr.distort(PICTURE, CAMERA, VIEW), ValueError, r"picture of the size of view, \(20, 24\)", r"\(15, 16\)"),
    "picture_of_another_size": (lambda: fr.distort(IMAGE, VIEW, CAMERA), ValueError, r"picture of the size of view, \(15, 16\)", r"\(20, 24\)"),
    "cameras_do_not_match": (lambda: fr.distort(PICTURE, VIEW, THREE), ValueError, r"camera.params of shape \(B, 8\) with B = 2 \(the picture batch\)", r"\(3, 8\)"),
    "rotation_is_an_array": (lambda: fr.distort(PICTURE, VIEW, CAMERA, rotation=np.eye(3)), TypeError, "rotation as a torch.Tensor", "ndarray"),
    "rotation_is_a_list": (lambda: fr.distort(PICTURE, VIEW, CAMERA, rotation=np.eye(3).tolist()), TypeError, "rotation as a torch.Tensor", "list"),
    "rotation_vector": (lambda: fr.distort(PICTURE, VIEW, CAMERA, rotation=torch.ones(3)), ValueError, r"rotation of shape \(3, 3\)", r"\(3,\)"),
    "no_view": (lambda: fr.distort(PICTURE, None, CAMERA), TypeError, "view as a camera", "NoneType"),
}  # fmt: skip

RESAMPLE = {
    "source_is_no_camera": (lambda: fr.resample(IMAGE, "fisheye", VIEW), TypeError, "source as a camera", "str"),
    "image_of_another_size": (lambda: fr.resample(IMAGE, VIEW, CAMERA), ValueError, "image of the size of source", r"\(20, 24\)"),
    "targets_do_not_match": (lambda: fr.resample(IMAGE, CAMERA, THREE), ValueError, r"target.params of shape \(B, 8\) with B = 2", r"\(3, 8\)"),
}  # fmt: skip

LAYER = {
    "view_is_no_camera": (lambda: fr.DistortionRectification(100), TypeError, "view as a camera", "int"),
    "camera_is_a_view": (lambda: fr.DistortionRectification(VIEW, camera=VIEW), TypeError, "camera as a FisheyeCamera", "PinholeCamera"),
    "no_params_and_no_camera": (lambda: fr.DistortionRectification(VIEW)(IMAGE), TypeError, "params, as the layer has no camera", "None"),
    "unknown_padding": (lambda: fr.DistortionRectification(VIEW, padding="wrap"), ValueError, "padding in", "'wrap'"),
    "unknown_interpolation": (lambda: fr.DistortionRectification(VIEW, interpolation=1), ValueError, "interpolation in", "1"),
}  # fmt: skip

LAYER_CALL = {
    "params_of_another_count": (lambda: layer(IMAGE, torch.zeros(2, 4)), ValueError, r"params of shape \(8,\) or \(B, 8\)", r"\(2, 4\)", "FisheyeCamera"),
    "params_of_integers": (lambda: layer(IMAGE, torch.zeros(2, 8).int()), ValueError, "params of a floating dtype", "int32", "FisheyeCamera"),
    "image_of_another_size_than_its_camera": (lambda: layer(IMAGE[..., 1:], None, camera=CAMERA), ValueError, "image of the size of camera", r"\(", "rectify"),
    "params_of_another_batch": (lambda: layer(IMAGE, torch.zeros(3, 8)), ValueError, r"camera.params of shape \(B, 8\) with B = 2", r"\(3, 8\)", "rectify"),
    "image_of_3_dimensions": (lambda: layer(IMAGE[0], torch.zeros(8)), ValueError, "image of shape", r"\(3, 20, 24\)", "rectify"),
    "image_of_1_dimension": (lambda: layer(IMAGE[0, 0, 0], torch.zeros(8)), ValueError, "image of shape", r"\(24,\)", "rectify"),
    "image_is_an_array": (lambda: layer(ARRAY, torch.zeros(8)), TypeError, "image as a torch.Tensor", "ndarray", "rectify"),
    "image_is_a_list": (lambda: layer([1], torch.zeros(8)), TypeError, "image as a torch.Tensor", "list", "rectify"),
}  # fmt: skip

DOOR_RECTIFY = {
    "tensor": (lambda: door.rectify(IMAGE, CAMERA, VIEW), TypeError, "image as a NumPy array", "Tensor"),
    "list": (lambda: door.rectify([[0]], CAMERA, VIEW), TypeError, "image as a NumPy array", "list"),
    "batch": (lambda: door.rectify(ARRAY[None], CAMERA, VIEW), ValueError, r"image of shape \(H, W\) or \(H, W, C\)", r"\(1, 20, 24, 3\)"),
    "no_pixels": (lambda: door.rectify(ARRAY[:0], CAMERA, VIEW), ValueError, r"image of shape \(H, W\) or \(H, W, C\)", r"\(0, 24, 3\)"),
    "another_size": (lambda: door.rectify(ARRAY[:-1], CAMERA, VIEW), ValueError, r"image of the size of camera, \(20, 24\)", r"\(19, 24\)"),
    "complex": (lambda: door.rectify(ARRAY.astype(complex), CAMERA, VIEW), ValueError, "image of a floating or integer dtype", "complex128"),
    "objects": (lambda: door.rectify(ARRAY.astype(object), CAMERA, VIEW), ValueError, "image of a floating or integer dtype", "object"),
    "text": (lambda: door.rectify(ARRAY.astype("S1"), CAMERA, VIEW), ValueError, "image of a floating or integer dtype", "S1"),
    "other_byte_order": (lambda: door.rectify(ARRAY.astype(">f4"), CAMERA, VIEW), ValueError, "image of a .*dtype", ">f4"),
    "long_double": (lambda: door.rectify(ARRAY.astype(np.longdouble), CAMERA, VIEW), ValueError, "image of a .*dtype", np.dtype(np.longdouble).name),
    "labels_mixed": (lambda: door.rectify(ARRAY.astype(np.int32), CAMERA, VIEW), ValueError, "image of a floating dtype, uint8 or uint16 for bilinear", "int32"),
    "mask_mixed": (lambda: door.rectify(ARRAY > 0, CAMERA, VIEW), ValueError, "image of a floating dtype, uint8 or uint16 for bilinear", "bool"),
    "cameras": (lambda: door.rectify(ARRAY, THREE, VIEW), ValueError, "one camera", "a batch of 3"),
    "views": (lambda: door.rectify(ARRAY, CAMERA, THREE_VIEWS), ValueError, "one view", "a batch of 3"),
    "no_camera": (lambda: door.rectify(ARRAY, None, VIEW), TypeError, "camera as a camera", "NoneType"),
    "rotation_2x2": (lambda: door.rectify(ARRAY, CAMERA, VIEW, rotation=np.eye(2)), ValueError, r"rotation of shape \(3, 3\)", r"\(2, 2\)"),
    "rotation_is_text": (lambda: door.rectify(ARRAY, CAMERA, VIEW, rotation="left"), TypeError, r"rotation as .*numbers", "left|str"),
    "threads": (lambda: door.rectify(ARRAY, CAMERA, VIEW, threads=0), ValueError, "threads of at least 1", "0"),
    "half_a_thread": (lambda: door.rectify(ARRAY, CAMERA, VIEW, threads=1.5), (TypeError, ValueError), "threads", "1.5"),
    "interpolation": (lambda: door.rectify(ARRAY, CAMERA, VIEW, interpolation="cubic"), ValueError, "interpolation in", "'cubic'"),
    "padding": (lambda: door.rectify(ARRAY, CAMERA, VIEW, padding=None), ValueError, "padding in", "None"),
}  # fmt: skip

DOOR_DISTORT = {
    "tensor": (lambda: door.distort(PICTURE, VIEW, CAMERA), TypeError, "picture as a NumPy array", "Tensor"),
    "another_size": (lambda: door.distort(ARRAY, VIEW, CAMERA), ValueError, "picture of the size of view", r"\(20, 24\)"),
    "rotation_vector": (lambda: door.distort(ARRAY[:h, :w], VIEW, CAMERA, rotation=[0, 0, 1]), ValueError, r"rotation of shape \(3, 3\)", r"\(3,\)"),
}  # fmt: skip

FISHEYE = {
    "seven_numbers": (lambda: fr.FisheyeCamera(PARAMS[:7], (H, W)), ValueError, r"params of shape \(8,\) or \(B, 8\)", r"\(7,\)"),
    "pinhole_params": (lambda: fr.FisheyeCamera(VIEW.params, (H, W)), ValueError, r"params of shape \(8,\) or \(B, 8\)", r"\(4,\)"),
    "three_dimensions": (lambda: fr.FisheyeCamera(np.zeros((1, 2, 8)), (H, W)), ValueError, "params of shape", r"\(1, 2, 8\)"),
    "ragged": (lambda: fr.FisheyeCamera([PARAMS, PARAMS[:7]], (H, W)), ValueError, "params of shape", "ragged"),
    "text": (lambda: fr.FisheyeCamera(["a"] * 8, (H, W)), TypeError, "params as numbers", "<U1"),
    "nothing": (lambda: fr.FisheyeCamera(None, (H, W)), TypeError, "params as numbers", "object"),
    "complex": (lambda: fr.FisheyeCamera([1j] * 8, (H, W)), TypeError, "params as numbers", "complex128"),
    "integer_tensor": (lambda: fr.FisheyeCamera(torch.zeros(8, dtype=torch.int64), (H, W)), ValueError, "params of a floating dtype", "torch.int64"),
    "size_is_a_number": (lambda: fr.FisheyeCamera(PARAMS, 100), TypeError, r"image_size as two integers \(height, width\)", "100"),
    "size_of_three": (lambda: fr.FisheyeCamera(PARAMS, (H, W, 3)), TypeError, "image_size as two integers", r"\(20, 24, 3\)"),
    "size_of_halves": (lambda: fr.FisheyeCamera(PARAMS, (H, 24.5)), TypeError, "image_size as two integers", r"24\.5"),
    "size_is_text": (lambda: fr.FisheyeCamera(PARAMS, "20x24"), TypeError, "image_size as two integers", "'20x24'"),
    "size_of_text": (lambda: fr.FisheyeCamera(PARAMS, ("a", "b")), TypeError, "image_size as two integers", "'a'"),
    "size_zero": (lambda: fr.FisheyeCamera(PARAMS, (0, W)), ValueError, r"image_size of at least \(1, 1\)", r"\(0, 24\)"),
    "size_infinite": (lambda: fr.FisheyeCamera(PARAMS, (math.inf, W)), TypeError, "image_size as two integers", "inf"),
    "size_nan": (lambda: fr.FisheyeCamera(PARAMS, (math.nan, W)), TypeError, "image_size as two integers", "nan"),
    "resize_to_nothing": (lambda: CAMERA.resize((0, 5)), ValueError, "image_size of at least", r"\(0, 5\)"),
    "crop_of_one_number": (lambda: CAMERA.crop(0, 0, 5), TypeError, "image_size as two integers", "5"),
}  # fmt: skip

PINHOLE = {
    "fisheye_params": (lambda: fr.PinholeCamera(PARAMS, (h, w)), ValueError, r"params of shape \(4,\) or \(B, 4\)", r"\(8,\)"),
}  # fmt: skip


def from_fov(fov_deg):
    return lambda: fr.PinholeCamera.from_fov(fov_deg, (h, w))


# Messages that name a classmethod or method.
METHODS = {
    "PinholeCamera.from_fov": {
        "of_180": (from_fov(180), ValueError, r"fov_deg in \(0, 180\)", "180"),
        "of_200": (from_fov(200), ValueError, r"fov_deg in \(0, 180\)", "200"),
        "of_0": (from_fov(0), ValueError, r"fov_deg in \(0, 180\)", "0"),
        "negative": (from_fov(-90), ValueError, r"fov_deg in \(0, 180\)", "-90"),
        "nan": (from_fov(math.nan), ValueError, r"fov_deg in \(0, 180\)", "nan"),
    },
    "PinholeCamera.from_focal": {
        "zero": (lambda: fr.PinholeCamera.from_focal(0, (h, w)), ValueError, "focal length above 0", "0"),
        "nan": (lambda: fr.PinholeCamera.from_focal(math.nan, (h, w)), ValueError, "focal length above 0", "nan"),
        "inf": (lambda: fr.PinholeCamera.from_focal(math.inf, (h, w)), ValueError, "focal length above 0", "inf"),
    },
    "PinholeCamera.from_matrix": {
        "2x2": (lambda: fr.PinholeCamera.from_matrix(np.eye(2), (h, w)), ValueError, r"K of shape \(3, 3\)", r"\(2, 2\)"),
        "skew": (lambda: fr.PinholeCamera.from_matrix([[1, 1, 0], [0, 1, 0], [0, 0, 1]], (h, w)), ValueError, "without skew", r"1\.0"),
    },
    "PinholeCamera.edge_matched": {
        "of_a_view": (lambda: fr.PinholeCamera.edge_matched(VIEW, (h, w)), TypeError, "camera as a FisheyeCamera", "PinholeCamera"),
        "of_params": (lambda: fr.PinholeCamera.edge_matched(PARAMS, (h, w)), TypeError, "camera as a FisheyeCamera", "list"),
    },
    "FisheyeCamera.from_opencv": {
        "K_3x4": (lambda: fr.FisheyeCamera.from_opencv(np.eye(3, 4), np.zeros(4), (H, W)), ValueError, r"K of shape \(3, 3\)", r"\(3, 4\)"),
        "D_of_5": (lambda: fr.FisheyeCamera.from_opencv(np.eye(3), np.zeros(5), (H, W)), ValueError, "4 coefficients k1..k4 in D", r"\(5,\)"),
        "skew": (lambda: fr.FisheyeCamera.from_opencv([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], np.zeros(4), (H, W)), ValueError, "without skew", r"0\.1"),
    },
    "FisheyeCamera.from_paper": {
        "equation_8": (lambda: fr.FisheyeCamera.from_paper(np.ones(8), (H, W), equation=8), ValueError, "equation 2 or 3", "8"),
    },
    "FisheyeCamera.from_projection": {
        "unknown": (lambda: fr.FisheyeCamera.from_projection("mercator", 90, (H, W)), ValueError, r"projection in \[.*'equidistant'", "'mercator'"),
        "of_360": (lambda: fr.FisheyeCamera.from_projection("equidistant", 360, (H, W)), ValueError, r"fov_deg in \(0, 360\)", "360"),
        "orthographic_200": (lambda: fr.FisheyeCamera.from_projection("orthographic", 200, (H, W)), ValueError, "fov_deg in .*orthographic", "200"),
        "nan": (lambda: fr.FisheyeCamera.from_projection("equisolid", math.nan, (H, W)), ValueError, "fov_deg in", "nan"),
    },
    "FisheyeCamera.project": {
        "points": (lambda: CAMERA.project(np.zeros((5, 2))), ValueError, r"rays of shape \(\.\.\., 3\)", r"\(5, 2\)"),
        "number": (lambda: CAMERA.project(1.0), ValueError, r"rays of shape", r"\(\)"),
        "another_batch": (lambda: THREE.project(np.zeros((2, 3))), ValueError, r"rays of shape \(3, \.\.\., 3\)", r"\(2, 3\)"),
    },
    "PinholeCamera.unproject": {
        "rays": (lambda: VIEW.unproject(torch.zeros(5, 3)), ValueError, r"points of shape \(\.\.\., 2\)", r"\(5, 3\)"),
    },
    "FisheyeCamera.to_opencv": {"batch": (THREE.to_opencv, ValueError, "one camera", "a batch of 3")},
    "PinholeCamera.to_matrix": {"batch": (THREE_VIEWS.to_matrix, ValueError, "one camera", "a batch of 3")},
    "FisheyeCamera.save": {"batch": (lambda: THREE.save("never.json"), ValueError, "one camera", "a batch of 3")},
}  # fmt: skip

GROUPS = {
    "rectify": RECTIFY,
    "distort": DISTORT,
    "resample": RESAMPLE,
    "DistortionRectification": LAYER,
    "FisheyeCamera": FISHEYE,
    "PinholeCamera": PINHOLE,
    **METHODS,
}
CASES = {f"{function}-{name}": (function, *case) for function, group in GROUPS.items() for name, case in group.items()}
CASES |= {f"layer-{name}": (case[4], *case[:4]) for name, case in LAYER_CALL.items()}
CASES |= {f"numpy.rectify-{name}": ("rectify", *case) for name, case in DOOR_RECTIFY.items()}
CASES |= {f"numpy.distort-{name}": ("distort", *case) for name, case in DOOR_DISTORT.items()}


@pytest.mark.parametrize(("function", "bad_call", "exception", "expected", "came"), CASES.values(), ids=CASES)
def test_the_message_names_function_argument_expected_and_got(function, bad_call, exception, expected, came):
    with pytest.raises(exception, match=rf"^{function.replace('.', '[.]')}\(\): expected .*{expected}") as caught:
        bad_call()
    message = str(caught.value)
    assert "\n" not in message
    with pytest.raises(AssertionError, match=f"got .*({came})"):
        raise AssertionError(message)


@pytest.mark.parametrize("name", ["rectangle", "Rectifyer", "nump"])
def test_unknown_names_of_the_package(name):
    with pytest.raises(AttributeError, match=f"module 'fisheyerec' has no attribute '{name}'"):
        getattr(fr, name)


def test_all_public_names_are_there():
    assert sorted(fr.__all__) == fr.__all__
    assert all(getattr(fr, name) is not None for name in fr.__all__)
    assert set(fr.__all__) <= set(dir(fr))


BROKEN = """
import sys
sys.modules["fisheyerec._C"] = None
import fisheyerec as fr
fr.FisheyeCamera.from_projection("equidistant", 180, image_size=(60, 80))
try:
    fr.rectify
except RuntimeError as error:
    print(error)
"""


def test_a_broken_installation_says_so(run_python):
    done = run_python(BROKEN)
    assert done.stderr == ""
    assert done.stdout.startswith("fisheyerec: the compiled torch op fisheyerec._C cannot be loaded; reinstall")
    assert done.stdout.count("\n") == 1
