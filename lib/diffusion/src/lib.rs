//! Latent diffusion models at any size: model folders in the diffusers
//! layout, layers whose gradients pass, samplers, LoRA and score distillation.
