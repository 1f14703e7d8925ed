"""The motor: parameters, equations, faults, and the file that holds its data sheet.

Begin at `model.continuous_model`.

Example:
    >>> from motor_env import PAPER_MOTOR, Fault
    >>> from motor_env.motor.faults import apply_fault
    >>> from motor_env.motor.model import steady_state
    >>> worn = apply_fault(PAPER_MOTOR, Fault("bearing", 0.25))
    >>> for motor in (PAPER_MOTOR, worn):
    ...     current_a, speed_rad_s = steady_state(motor, 12.0)
    ...     print(f"{1000 * current_a:.1f} mA at {speed_rad_s:.0f} rad/s")
    25.9 mA at 508 rad/s
    32.4 mA at 507 rad/s
"""
