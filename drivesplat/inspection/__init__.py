"""Looking at a trained model: ghost panel, removal of a vehicle, track table."""
