"""Places in the vector of a recorded motor's values, SI: what is fitted, and what is known beside it."""

(R, L, K, J, B, COULOMB, DROP, LOAD, SQUARE, OFFSET_I, OFFSET_W, HEATING, COOLING, LAG_I, LAG_W, DELAY) = (
    range(16)
)
(NOISE_I, NOISE_W, NOISE_V, WALK) = range(16, 20)
"""Standard deviations of a sample of current, speed and voltage; of the load in a second."""
DRAG = 20
"""A factor on the friction, where it is fitted as a whole; 0 for none."""
(KNEE, STRIBECK, SLIDING) = range(21, 24)
"""The current at which the brush drop sets in, the share that dry friction is larger at low speed, and the speed at
which it sets in."""
(ONSET, AFTER, RISE, ZONE) = range(24, 28)
"""Seconds from the first sample to the step of the supply, and from there to the next sample; in which the supply
rises; the current below which the sensor hides it."""
CURVE = slice(28, 32)
"""How much of the supply's rise falls on the second and every later fifth of it, times that on the first."""
GEAR = 32
"""The share of the motor's torque that its gear loses."""
N_VALUES = 33
