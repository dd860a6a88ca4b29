"""What a CUDA training script needs on a machine without a GPU: see `examples/hosts/on_cpu.py`."""
