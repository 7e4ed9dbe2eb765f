"""The control loop: fingers, actuators, the service that calls the controller once per cycle."""
