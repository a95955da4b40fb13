"""Planning with world models: iCEM, controllers, and the servo evaluation."""
