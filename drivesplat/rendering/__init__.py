"""Films and frames of trained models: camera paths, panels, captions, the encoder."""
