"""
Uncertainty of models you have: lists of python-control systems
===============================================================

I have a model of every machine. What are the nominal model and the weights for robust control?

The models may come from any identification. You need no recordings, liftings or observers. The models are ``control.ss`` or
``control.frd`` with a sampling period (``sample`` gives a continuous model one, ``kros.interop.from_control`` converts a
``control.tf``). ``kros.interop.to_control`` converts nominal and weights.
"""

# %%
# The models
# ----------
#
# Eight servo axes: a motor drives a load through a shaft. Inertias, friction, stiffness and gain of the amplifier differ by
# 3 to 20 percent.

import control
import numpy as np

rng = np.random.default_rng(5)


def axis():
    """Return one axis, from the command (A) to the speeds of motor and load (rad/s)."""
    spread = 1 + np.array([0.1, 0.03, 0.05, 0.05, 0.2]) * rng.uniform(-1, 1, 5)
    gain, motor, load, stiffness, friction = [0.5, 0.002, 0.004, 8.0, 0.01] * spread
    damping = 0.03
    # states: speed of the motor, speed of the load, twist of the shaft
    A = [
        [-(friction + damping) / motor, damping / motor, -stiffness / motor],
        [damping / load, -(friction + damping) / load, stiffness / load],
        [1, -1, 0],
    ]
    B = [[gain / motor], [0], [0]]
    C = [[1, 0, 0], [0, 1, 0]]
    return control.ss(A, B, C, 0, inputs=["command"], outputs=["motor", "load"]).sample(0.001)


models = {f"axis {k}": axis() for k in range(1, 9)}
print(models["axis 1"])

# %%
# Which form?
# -----------
#
# :math:`G` is the nominal model, :math:`G_p` any of the others, and the residual :math:`E = W_L \Delta W_R` with :math:`\bar\sigma(\Delta) \le 1`:
#
# =============================  =================================
# form                           residual
# =============================  =================================
# additive                       :math:`G_p - G`
# input multiplicative           :math:`G^+(G_p - G)`
# output multiplicative          :math:`(G_p - G)G^+`
# inverse additive               :math:`G_p^+(G_p - G)G^+`
# inverse input multiplicative   :math:`G_p^+(G_p - G)`
# inverse output multiplicative  :math:`(G_p - G)G_p^+`
# =============================  =================================
#
# kros computes all six. An axis has two outputs and one input. A form with one residual at the input cannot represent
# differences between the outputs; ``misfit`` is the approximation error.

import kros
from kros.interop import to_control
from kros.uncertainty import Form

freqs_hz = np.geomspace(0.1, 100, 120)
results = {form: kros.quantify(models, form, freqs_hz) for form in Form}
print("form                           nominal  peak (dB)  misfit  states of the weights")
for form, model in results.items():
    states = f"{model.weight.left.n_states} and {model.weight.right.n_states}"
    peak, misfit = model.peak_db[form], model.misfit_max
    print(f"{form.value:30s} {model.nominal_id:8s} {peak:9.1f}  {misfit:6.3f}  {states}")

# %%
# Peaks of different forms are not comparable. An additive residual is the difference itself; a multiplicative one is relative
# to the plant. If an inverse residual is below one (0 dB), every plant in the set is well-posed. At low frequencies the axes
# differ in gain and friction, near 12 Hz in the resonance of the shaft, and above it in the inertias. The output multiplicative
# form has no approximation error and is below -10 dB everywhere, so we take it.

import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(7.4, 3.6), layout="constrained")
found = results[Form.OUTPUT_MULTIPLICATIVE]
for form in Form:
    size_db = 20 * np.log10(found.bounds[form])
    axes.semilogx(found.freqs_hz, size_db, label=form.value.replace("_", " "))
axes.axhline(0, color="k", linewidth=0.5)
axes.set(xlabel="frequency (Hz)", ylabel="largest residual (dB)")
axes.set_title(f"eight axes, nominal {found.nominal_id}")
axes.legend(fontsize="small", ncols=2)
plt.show()

# %%
# Nominal and weights
# -------------------
#
# ``to_control`` makes systems of python-control of them. The bound holds at all frequencies.

nominal = to_control(found.nominal_system, name="nominal")
left, right = to_control(found.weight.left, name="left"), to_control(found.weight.right, name="right")
print("nominal:", found.nominal_id)
print("states of nominal and weights:", nominal.nstates, left.nstates, right.nstates)

# %%
print(found.summary())
found.plot()

# %%
# Check it by hand
# ----------------
#
# We verify :math:`\bar\sigma(W_L^{-1} E W_R^{-1}) \le 1` for every axis with python-control and numpy alone. Weights act on
# scaled signals; the scales are in the result.

omega = 2 * np.pi * np.geomspace(0.1, 100, 1000)


def response(system):
    """Return the frequency response, shape (n_freqs, outputs, inputs)."""
    return np.moveaxis(system(np.exp(1j * omega * system.dt), squeeze=False), -1, 0)


scale_out, scale_in = found.output_scale[:, None], found.input_scale
scaled_nominal = response(nominal) / scale_out * scale_in
left, right = response(left), response(right)

figure, axes = plt.subplots(figsize=(7.4, 3.2), layout="constrained")
largest = {}
for name, system in models.items():
    scaled = response(system) / scale_out * scale_in
    residual = (scaled - scaled_nominal) @ np.linalg.pinv(scaled_nominal)
    delta = np.linalg.inv(left) @ residual @ np.linalg.inv(right)
    size = np.linalg.norm(delta, ord=2, axis=(1, 2))
    largest[name] = size.max()
    if name != found.nominal_id:
        axes.semilogx(omega / (2 * np.pi), size, label=name)
axes.axhline(1, color="k", linewidth=0.8)
axes.set(xlabel="frequency (Hz)", ylabel="residual over the weights", ylim=(0, 1.4))
axes.legend(fontsize="small", ncols=4, loc="upper left")
plt.show()
print(f"largest over all axes and frequencies: {max(largest.values()):.5f}")

# %%
# On with python-control
# ----------------------
#
# The weights are stable and minimum phase, ready for a generalized plant: `control.mixsyn`, or `kros.synthesis.hinf` with a certificate that is recomputed
# from the closed loop. The same works for measured frequency responses (``control.frd``), where the bound holds at the frequencies given.

print("poles of the left weight, stable:", bool(np.all(np.abs(to_control(found.weight.left).poles()) < 1)))
points = 2 * np.pi * freqs_hz
measured = [control.frd(system, points) for system in models.values()]
print(kros.quantify(measured, Form.OUTPUT_MULTIPLICATIVE).certificate)
