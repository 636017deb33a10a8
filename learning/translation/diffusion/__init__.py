"""The paper's translator: SD-Turbo's autoencoder and UNet with adapters, in a single step.

The user supplies the published weights; diffusers, peft and transformers are imported only when
used.
"""
