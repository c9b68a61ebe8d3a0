"""Live ROS 2 without a ROS installation: Zenoh in the conventions of rmw_zenoh, and the three nodes of the paper."""
