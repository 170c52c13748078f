"""What the rules ask: plan, stages, inputs, jobs, GPUs and measured costs."""
