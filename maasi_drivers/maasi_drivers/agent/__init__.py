"""What every driver does: goals, odometry, measurement batches, health, safety."""
