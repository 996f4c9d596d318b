"""A recorded column with another sign scores higher than the simulation as it is recorded."""

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.score import basis_of, score
from mkc_torch.diagnosis.search.columns import best_change
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.recording.recording import Recording
from tests.diagnosis.swing import Pendulum, pendulum_recording


def gain(factor):
    """Nats by which a changed column scores higher, and the change; the torque is recorded times a factor."""
    known = pendulum_recording(N=300)[0]
    columns = {name: known[name] * (factor if name == "torque" else 1.0) for name in known.names}
    prepared = Pendulum().prepare(Recording(columns, units=known.units))
    fit = fitted(JointModel(prepared), prepared.start())
    basis = basis_of(fit, 10, {}, Settings())
    alone, change = score(fit, basis, Settings()), best_change([fit], basis, Settings(), poor=False)
    return change.value - alone.value, change.change


def test_a_torque_recorded_with_the_wrong_sign_is_named():
    nats, change = gain(-1.0)
    assert nats > 50.0
    assert (change.column, change.factor) == ("torque", -1.0)


def test_a_torque_recorded_as_it_acts_is_not_changed():
    assert gain(1.0)[0] < -50.0
