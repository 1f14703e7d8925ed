"""Indices of the vector of a recorded motor's values, SI: what is fitted, and what is known beside it."""

(R, L, K, J, B, COULOMB, DROP, LOAD, SQUARE, OFFSET_I, OFFSET_W, LAG_I, LAG_W, DELAY) = range(14)
(NOISE_I, NOISE_W, NOISE_V, NOISE_T, WALK) = range(14, 19)
"""Standard deviations: of a sample of current and speed; of voltage and torque in each interval; of the load in a
second."""
DRAG = 19
"""Factor on the friction, where it is fitted as a whole; 0 for none."""
(KNEE, STRIBECK, SLIDING) = range(20, 23)
"""Current at which the brush drop sets in; share by which dry friction is larger at low speed; speed at which it sets
in."""
(ONSET, AFTER, RISE, ZONE) = range(23, 27)
"""Seconds from the first sample to the supply's step; from there to the next sample; of the supply's rise. The current
below which a sensor shows none."""
CURVE = slice(27, 31)
"""Rise of the supply in the second and every later fifth of it, over that in the first."""
GEAR = 31
"""Share of the motor's torque that its gear loses."""
SOURCE = 32
"""Resistance of the supply: a held voltage falls as the current rises after its sample."""
N_VALUES = 33
