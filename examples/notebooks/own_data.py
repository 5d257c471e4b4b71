"""
From your own arrays to a running observer
==========================================

How do I get from arrays of recordings to an observer?

Eight machines of one batch were recorded on a test bench, which has one sensor more than the product. From these arrays we
design one observer for all machines of the batch.

The machines are pendulums driven by a motor. Every machine has an encoder for the angle. The rate was recorded on the bench
only. Replace the first cell by your own arrays and their names; the other cells stay as they are.
"""

# %%
# The recordings
# --------------
#
# Each episode is an array of shape (samples, channels): states first, then inputs. The episodes of one machine are a list,
# and the machines are the keys of a dictionary. Gravity, damping and gain differ from machine to machine:
#
# .. math:: \ddot\theta = -a \sin\theta - b \dot\theta + g u

import numpy as np

PERIOD = 0.01  # s
ENCODER = 2 * np.pi / 4096  # rad, one count
rng = np.random.default_rng(7)


def swing(parameters, torque, steps=5):
    """Simulate angle and rate of one machine, shape (n_samples, 2)."""
    gravity, damping, gain = parameters
    angle = rate = 0.0
    samples = []
    for u in torque:
        samples.append((angle, rate))
        for _ in range(steps):
            rate += PERIOD / steps * (gain * u - damping * rate - gravity * np.sin(angle))
            angle += PERIOD / steps * rate
    return np.array(samples)


def record(parameters, seconds=10.0):
    """Record one episode, driven by a staircase of torques."""
    torque = np.repeat(rng.uniform(-2.5, 2.5, int(seconds / PERIOD / 50)), 50)
    truth = swing(parameters, torque)
    angle = np.round(truth[:, 0] / ENCODER) * ENCODER
    rate = truth[:, 1] + 0.02 * rng.standard_normal(len(truth))
    return np.column_stack([angle, rate, torque]), truth


def machine():
    """Return gravity, damping and gain of a machine, up to 15 percent off."""
    return [20.0, 0.8, 6.0] * (1 + np.array([0.08, 0.15, 0.08]) * rng.uniform(-1, 1, 3))


recordings = {}
for name in "ABCDEFGH":
    parameters = machine()
    recordings[name] = [record(parameters)[0] for _ in range(5)]

# %%
# Name the columns, and the states that are measured at run time.

import kros

population = kros.from_arrays(
    recordings,
    states=["angle", "rate"],
    inputs=["torque"],
    measured=["angle"],
    sample_period_s=PERIOD,
)
print(population.summary())
population.plot()

# %%
# Identify
# --------
#
# The restoring torque is proportional to the sine of the angle, so we lift with this function: the model of a machine is
# linear in angle, rate and sine. kros also identifies linear models without it. The last episode of every machine is held out.

models = kros.identify(population, lifting=["sin(angle)"])
print(models.summary())
models.plot()

# %%
# Simulate a held-out episode with the models of its machine. Above the signals stands the fit: 100 percent is exact.

models.plot("compare")

# %%
# Quantify how the machines differ
# --------------------------------
#
# kros computes six forms of uncertainty. The additive form represents every difference exactly. The nominal machine is the
# one from which the farthest other machine is nearest. In the last panel all machines are below one: the set contains them.

uncertain = kros.quantify(models, form="additive")
found = uncertain.sets["koopman"]
print(uncertain)
print(f"largest residual over its bound: {found.cover_max:.4f}")
uncertain.plot()

# %%
# Synthesize
# ----------
#
# ``worst_case_h2`` minimises the mean square error over the uncertain set. ``estimator`` is a regression on a bank of stable
# filters of angle, sine and torque. Without the name of a method, ``kros.synthesize(uncertain)`` compares all methods and
# returns the observer that a study would deploy. That takes longer.

design = kros.synthesize(uncertain, "worst_case_h2", methods=())
estimator = kros.synthesize(uncertain, "koopman/estimator", methods=())
print(design)
print(estimator)
design.plot(models=models)

# %%
# Run it on a new machine
# -----------------------
#
# The ninth machine of the batch took no part in the design. ``step`` takes the measurement and the input of one sample and
# returns the estimate of the next sample.

recording, truth = record(machine())


def estimate(observer):
    """Estimate the rate of the new machine, sample by sample."""
    running = observer.start(recording[:1, 0])
    rates = [0.0]
    for angle, _, torque in recording[:-1]:
        rates.append(running.step([angle], [torque])["rate"])
    return np.array(rates)


angle, true_rate = recording[:, 0], truth[:, 1]
estimates = {
    "worst-case H2, Koopman": estimate(design.observer),
    "estimator": estimate(estimator.observer),
    "difference of two angles": np.diff(angle, prepend=angle[0]) / PERIOD,
}
errors = {}
for name, rate in estimates.items():
    errors[name] = error = np.sqrt(np.mean((rate - true_rate) ** 2))
    percent = 100 * error / np.abs(true_rate).max()
    print(f"{name:25s} {error:6.3f} rad/s, {percent:.2f} % of the largest rate")

# %%

import matplotlib.pyplot as plt

time = PERIOD * np.arange(len(truth))
figure, (above, below) = plt.subplots(2, sharex=True, figsize=(7, 5), layout="tight")
above.plot(time, true_rate, "k", label="true")
above.plot(time, estimates["estimator"], "--", label="estimated")
above.set(ylabel="rate (rad/s)", ylim=(-10, 12))
above.legend(loc="upper right", ncols=2)
for name, rate in reversed(estimates.items()):
    below.plot(time, rate - true_rate, linewidth=0.8, label=name)
below.set(xlabel="time (s)", ylabel="error (rad/s)", ylim=(-0.4, 0.5))
below.legend(loc="upper right", ncols=3, fontsize="small")
plt.show()

# %%
# Save it
# -------
#
# A design is saved as a folder with JSON and arrays. ``kros.export.export_c`` writes the observer as C99 with a self-test.

from pathlib import Path
from tempfile import TemporaryDirectory

from kros.design import Design

with TemporaryDirectory() as folder:
    design.save(folder)
    print(sorted(path.name for path in Path(folder).iterdir()))
    again = Design.load(folder)

print(np.array_equal(estimate(again.observer), estimates["estimator"]))
