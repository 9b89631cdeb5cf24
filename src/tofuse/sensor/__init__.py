"""What is known of the sensor: noise, corrections, named cameras."""
