"""The MuJoCo substrate: world, robot, sensors, skills, people, faults. The only room that imports mujoco."""
