"""The quick encoders write what rosbags writes, byte by byte."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from omnibench.live.encoders import OdometryEncoder, TransformsEncoder
from omnibench.live.messages import ODOMETRY, TRANSFORMS, Odometry, Transform

NUMBERS = st.floats(-1e6, 1e6)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
FRAMES = st.text("abcdefghij/_", min_size=0, max_size=12)


def vector() -> st.SearchStrategy[np.ndarray]:
    return arrays(float, 3, elements=NUMBERS)


def square() -> st.SearchStrategy[np.ndarray]:
    return arrays(float, (3, 3), elements=NUMBERS)


@given(FRAMES, FRAMES, st.lists(st.tuples(STAMPS, vector(), square(), vector(), square()), min_size=1, max_size=3))
def test_odometry_of_fixed_frames_is_encoded_as_rosbags_does(frame: str, child: str, contents: list) -> None:  # type: ignore[type-arg]
    encoder = OdometryEncoder(frame, child)
    for stamp, *numbers in contents:
        message = Odometry(stamp, frame, child, *numbers)
        assert encoder.encode(message) == ODOMETRY.encode(message)


@given(st.lists(st.tuples(FRAMES, FRAMES), min_size=1, max_size=3), st.data())
def test_transforms_of_fixed_frames_are_encoded_as_rosbags_does(frames: list, data: st.DataObject) -> None:  # type: ignore[type-arg]
    encoder = TransformsEncoder(frames)
    for _ in range(2):
        transforms = [Transform(data.draw(STAMPS), *pair, data.draw(vector())) for pair in frames]
        assert encoder.encode(transforms) == TRANSFORMS.encode(transforms)
