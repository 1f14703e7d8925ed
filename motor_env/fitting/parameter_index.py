"""Places in the vector of a recorded motor's values, SI: what is fitted, and what is known beside it."""

(R, L, K, J, B, COULOMB, DROP, LOAD, SQUARE, OFFSET_I, OFFSET_W, HEATING, COOLING, LAG_I, LAG_W, DELAY) = (
    range(16)
)
(NOISE_I, NOISE_W, NOISE_V, NOISE_T, WALK) = range(16, 21)
"""Standard deviations of a sample of current and speed; of the voltage and of the torque in an interval, other in each;
of the load in a second."""
DRAG = 21
"""A factor on the friction, where it is fitted as a whole; 0 for none."""
(KNEE, STRIBECK, SLIDING) = range(22, 25)
"""The current at which the brush drop sets in, the share that dry friction is larger at low speed, and the speed at
which it sets in."""
(ONSET, AFTER, RISE, ZONE) = range(25, 29)
"""Seconds from the first sample to the step of the supply, and from there to the next sample; in which the supply
rises; the current below which the sensor hides it."""
CURVE = slice(29, 33)
"""How much of the supply's rise falls on the second and every later fifth of it, times that on the first."""
GEAR = 33
"""The share of the motor's torque that its gear loses."""
N_VALUES = 34
