"""LeRobot data sets: joints and commands by name, episodes as runs."""

import json

import numpy as np
import pytest

from mkc_torch.recording import Recording, RecordingError

polars = pytest.importorskip("polars")

STATES = np.arange(24, dtype=np.float32).reshape(8, 3)


def written(folder, names, states=STATES, file="data/chunk-000/file-000.parquet"):
    """A data set of two episodes of four frames at 10 Hz."""
    path = folder / file
    path.parent.mkdir(parents=True)
    if names is not None:
        (folder / "meta").mkdir()
        features = {key: {"dtype": "float32", "names": names} for key in ("observation.state", "action")}
        (folder / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v3.0", "features": features}))
    polars.DataFrame(
        {
            "observation.state": [list(row) for row in states],
            "action": [list(row + 0.5) for row in STATES],
            "timestamp": np.tile(np.arange(4, dtype=np.float32) / 10, 2),
            "frame_index": np.tile(np.arange(4), 2),
            "episode_index": np.repeat([0, 1], 4),
            "task_index": np.zeros(8, int),
        }
    ).write_parquet(path)
    return path


@pytest.mark.parametrize(
    ("names", "joints", "commands"),
    [
        (["pan.pos", "lift.pos", "grip.pos"], ("pan", "lift", "grip"), ("pan_ctrl", "lift_ctrl", "grip_ctrl")),
        (
            {"motors": ["pan", "lift", "left-grip"]},
            ("pan", "lift", "left_grip"),
            ("pan_ctrl", "lift_ctrl", "left_grip_ctrl"),
        ),
        (["motors"], ("state_0", "state_1", "state_2"), ("action_0", "action_1", "action_2")),
        (None, ("state_0", "state_1", "state_2"), ("action_0", "action_1", "action_2")),
    ],
)
def test_joints_and_commands_have_the_names_of_the_data_set(tmp_path, names, joints, commands):
    recording = Recording.read(written(tmp_path, names))
    assert recording.names == ("time", "experiment", *joints, *commands)
    np.testing.assert_array_equal(recording.stack(*joints).numpy(), STATES)
    np.testing.assert_array_equal(recording.stack(*commands).numpy(), STATES + 0.5)
    np.testing.assert_allclose(recording["time"].numpy(), np.tile(np.arange(4) / 10, 2), atol=1e-7)
    assert [len(run) for run in recording.experiments().values()] == [4, 4]


def test_a_file_of_version_2_holds_an_episode(tmp_path):
    path = written(tmp_path, ["pan.pos", "lift.pos", "grip.pos"], file="data/chunk-000/episode_000000.parquet")
    assert "pan_ctrl" in Recording.read(path)


def test_a_damaged_description_leaves_numbers(tmp_path):
    path = written(tmp_path, ["pan.pos", "lift.pos", "grip.pos"])
    (tmp_path / "meta" / "info.json").write_text("{")
    assert "state_0" in Recording.read(path)


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ([[1.0, 2.0]] * 7 + [[1.0]], "vectors of `observation.state` have 1 to 2 values"),
        ([["a", "b"]] * 8, "`observation.state` holds values that are no numbers"),
    ],
)
def test_vectors_that_are_no_table_are_refused(tmp_path, states, message):
    path = written(tmp_path, None, states=states)
    with pytest.raises(RecordingError, match=message):
        Recording.read(path)
