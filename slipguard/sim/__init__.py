"""The simulated cell: a gripper, an arm, two gels and an object, as pure functions of time."""
