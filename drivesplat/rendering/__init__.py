"""Films and frames of trained models: panels, captions, the encoder."""
