"""Inference from a transient: fits, posterior probabilities of faults and their severity.

Begin at `posterior.class_probabilities`.

Example:
    The probability of each class, given the start-up current and the recipe from which motors are drawn.

    >>> from motor_datasets import generate_arrays
    >>> from motor_env import class_probabilities, load_recipe
    >>> starts = generate_arrays(load_recipe("bench"), seed=1, cases=range(3))
    >>> print(class_probabilities(load_recipe("bench"), starts.X).round(2))
    [[0.   0.   0.   0.   1.  ]
     [0.89 0.11 0.   0.   0.  ]
     [0.   0.   0.   0.   1.  ]]
"""
