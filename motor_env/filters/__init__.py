"""Kalman filters: batch, stream, smoother, adaptive noise, joint state and parameters, consistency tests.

They take measurements and an assumed model of the motor, never the truth. Begin at `kalman.KalmanFilter`.

Example:
    The filter of a healthy motor on the start of a healthy one: the residual is white noise of standard deviation
    1, up to chance.

    >>> from motor_env import PAPER_MOTOR, KalmanFilter, Scenario, SensorParameters, run_filter, simulate
    >>> sensor = SensorParameters(current_noise_a=0.02)
    >>> start = simulate(Scenario(PAPER_MOTOR, sensor=sensor), seed=1, cases=[0])
    >>> kalman = KalmanFilter.from_parameters(PAPER_MOTOR, sensor, dt_s=1e-4)
    >>> result = run_filter(kalman, start.measurements, start.voltage_v)
    >>> print(result.whitened.shape, f"{result.whitened.std():.2f}")
    (1, 1000, 1) 1.02
"""
