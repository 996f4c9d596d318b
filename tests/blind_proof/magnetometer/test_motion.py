import torch

from examples.blind_proof.draws import generator
from examples.blind_proof.magnetometer.motion import Motion, tumble, within
from mkc_torch.calibration.coverage import coverage


def test_the_default_motion_is_90_s_at_50_hz():
    motion = tumble(generator(0))
    assert len(motion.time) == 4500
    assert float(motion.time[1]) == 0.02


def test_gyro_is_the_rate_of_the_attitude():
    motion = tumble(generator(1), duration=5.0, rate=1000.0)
    field = motion.into_body(torch.tensor([20.0, -5.0, 40.0]).double().expand(len(motion.time), 3))
    change = torch.gradient(field, spacing=1e-3, dim=0)[0]
    expected = -torch.linalg.cross(motion.gyro, field)
    assert (change - expected)[5:-5].abs().max() < 0.01 * expected.abs().max()


def test_motions_have_moderate_rates_and_unit_quaternions():
    for index in range(20):
        motion = tumble(generator(2, index))
        assert 0.5 < motion.gyro.norm(dim=-1).square().mean().sqrt() < 4.5
        torch.testing.assert_close(motion.attitude.norm(dim=-1), torch.ones(4500).double())


def test_most_motions_cover_all_directions():
    down = torch.tensor([0.0, 0.0, 1.0]).double().expand(4500, 3)
    gaps = [bool(coverage(tumble(generator(3, k)).into_body(down)).gaps) for k in range(30)]
    assert sum(gaps) <= 6


def test_some_motions_rest_at_a_constant_position_and_attitude():
    motions = [tumble(generator(6, k)) for k in range(60)]
    rests = [(motion, motion.gyro.abs().amax(-1) == 0.0) for motion in motions]
    resting = [(motion, still) for motion, still in rests if bool(still.any())]
    assert 3 <= len(resting) <= 18
    for motion, still in resting:
        assert 0.04 < float(still.double().mean()) < 0.41
        assert int((still[1:] & ~still[:-1]).sum()) <= 1
        inside = torch.nonzero(still).flatten()[:-1]
        assert float((motion.position[inside + 1] - motion.position[inside]).abs().max()) == 0.0
        torch.testing.assert_close(motion.attitude[inside + 1], motion.attitude[inside])


def test_walking_motions_reach_beyond_a_metre_and_standing_motions_do_not():
    motions = [tumble(generator(4, k)) for k in range(40)]
    assert 4 <= sum(motion.walks for motion in motions) <= 22
    for motion in motions:
        reach = float((motion.position - motion.position.mean(0)).abs().max())
        assert reach > 1.0 if motion.walks else reach < 1.0


def test_an_accelerometer_at_rest_measures_gravity_upwards():
    time = torch.arange(10).double()
    level = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(10, 4)
    rest = Motion(time, level, torch.zeros(10, 3).double(), torch.zeros(10, 3).double(), False)
    torch.testing.assert_close(rest.accel, torch.tensor([0.0, 0.0, 9.81]).double().expand(10, 3))


def test_within_keeps_the_mean_and_reach_of_the_first_motion():
    first, second = tumble(generator(5, 0)), tumble(generator(5, 1))
    moved = within(second, first)
    torch.testing.assert_close(moved.position.mean(0), first.position.mean(0))

    def reach(motion):
        return (motion.position - motion.position.mean(0)).norm(dim=-1).max()

    assert reach(moved) <= reach(first) * (1 + 1e-12)
