"""Indices of the vector of a recorded motor's values, SI: what is fitted, and what is known beside it."""

(R, L, K, J, B, COULOMB, DROP, LOAD, SQUARE, OFFSET_I, OFFSET_W, HEATING, COOLING, LAG_I, LAG_W, DELAY) = (
    range(16)
)
(NOISE_I, NOISE_W, NOISE_V, NOISE_T, WALK) = range(16, 21)
"""Standard deviations: of a sample of current and speed; of voltage and torque in each interval; of the load in a
second."""
DRAG = 21
"""Factor on the friction, where it is fitted as a whole; 0 for none."""
(KNEE, STRIBECK, SLIDING) = range(22, 25)
"""Current at which the brush drop sets in; share by which dry friction is larger at low speed; speed at which it sets
in."""
(ONSET, AFTER, RISE, ZONE) = range(25, 29)
"""Seconds from the first sample to the supply's step; from there to the next sample; of the supply's rise. The current
below which a sensor shows none."""
CURVE = slice(29, 33)
"""Rise of the supply in the second and every later fifth of it, over that in the first."""
GEAR = 33
"""Share of the motor's torque that its gear loses."""
N_VALUES = 34
