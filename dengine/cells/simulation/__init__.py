"""A robot cell in MuJoCo: bin, gripper, compliant wrist, chamfered fixture, force sensor, height check."""
