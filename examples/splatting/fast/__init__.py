"""The compiled float32 twin of the reference rasterizer and of the photometric loss."""
