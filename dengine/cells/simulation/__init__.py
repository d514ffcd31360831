"""A robot cell simulated in MuJoCo: gripper, wrist, fixture, force sensor, height check."""
