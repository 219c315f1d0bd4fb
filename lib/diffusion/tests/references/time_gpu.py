"""What `dipir-model check` measured on a GPU, beside diffusers on the same GPU.

    python make.py --full sd21 FOLDER
    dipir-model check FOLDER --device cuda:0 --json > CHECK.json
    python time_gpu.py CHECK.json FOLDER

Milliseconds, in the precision of the check. An LDS iteration of diffusers is the encoding with its
gradient and two predictions in a batch; its update of a LoRA has two examples and the
crop's encoding. With it stands what gradient checkpointing, [lora] recompute, takes.
"""

import json
import pathlib
import sys
import time

import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from peft import LoraConfig
from transformers import CLIPTextModel


def least(run):
    """The fastest of five turns after one that compiles and allocates."""
    times = []
    for _ in range(6):
        torch.cuda.synchronize()
        start = time.perf_counter()
        run()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def main():
    check, folder = json.loads(pathlib.Path(sys.argv[1]).read_text()), pathlib.Path(sys.argv[2])
    dtype = getattr(torch, {"bf16": "bfloat16", "f16": "float16", "f32": "float32"}[check["precision"]])
    ours = check["times"]
    load = lambda kind, part: kind.from_pretrained(folder / part, torch_dtype=dtype).to("cuda").requires_grad_(False)
    unet, vae, text = load(UNet2DConditionModel, "unet"), load(AutoencoderKL, "vae"), load(CLIPTextModel, "text_encoder")
    side = ours["size"] // 8
    randn = lambda *shape: torch.randn(shape, device="cuda", dtype=dtype)
    image, context = randn(1, 3, 8 * side, 8 * side).clamp(-1, 1), randn(2, 77, unet.config.cross_attention_dim)
    latents = randn(2, 4, side, side)
    tokens = torch.randint(0, 49405, (2, 77), device="cuda")

    def encode():
        return vae.encode(image).latent_dist.mean

    def encode_with_gradient():
        image.requires_grad_()
        image.grad = None
        encode().backward(latents[:1])
        image.requires_grad_(False)

    def predict(batch):
        with torch.no_grad():
            return unet(latents[:batch], 400, context[:batch]).sample

    def guide():
        encode_with_gradient()
        predict(2)

    def update():
        with torch.no_grad():
            encode()
        with torch.autocast("cuda", dtype, enabled=dtype != torch.float32):
            loss = (unet(latents, 400, context).sample.float() - latents.float()).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    found = {}
    with torch.no_grad():
        found["text_s"] = least(lambda: text(tokens))
        found["encode_s"] = least(encode)
        found["decode_s"] = least(lambda: vae.decode(latents[:1]))
    found["unet_s"] = least(lambda: predict(1))
    found["sampling_step_s"] = least(lambda: predict(2))
    found["encode_with_gradient_s"] = least(encode_with_gradient)
    found["guidance_s"] = least(guide)
    unet.add_adapter(LoraConfig(r=4, lora_alpha=4, target_modules=["to_q", "to_k", "to_v", "to_out.0"]))
    trained = [p for p in unet.parameters() if p.requires_grad]
    for p in trained:
        p.data = p.data.float()
    optimizer = torch.optim.AdamW(trained)
    unet.train()
    found["lora_step_s"] = least(update)
    unet.enable_gradient_checkpointing()
    checkpointed = least(update)
    print(f"{torch.cuda.get_device_name()}, {check['precision']}, {ours['size']} pixels, PyTorch {torch.__version__}")
    for name, theirs in found.items():
        print(f"{name[:-2]:22} here {1e3 * ours[name]:8.2f} ms   diffusers {1e3 * theirs:8.2f} ms   ratio {ours[name] / theirs:.2f}")
    print(f"diffusers' update with recomputation {1e3 * checkpointed:.2f} ms")


if __name__ == "__main__":
    main()
