"""ROS 2 package of slipguard: a lifecycle node, a client of the local API. It does not import slipguard itself."""
