"""Makes the reference files of this folder with diffusers, transformers and peft.

    pip install torch diffusers transformers peft safetensors open_clip_torch
    python make.py                        # the small models that the tests read
    python make.py --only pooled          # one of them
    python make.py --full sd21 FOLDER     # one model at its real size, for
                                          # `cargo run --release --example parity FOLDER`

Weights are random, rounded to f16 so that the files are small and the f32 and
f16 readings of them agree. Made with torch 2.15.0, diffusers 0.42.1,
transformers 5.23.0, peft 0.21.2.
"""

import argparse
import gzip
import importlib.util
import json
import math
import pathlib

import numpy as np
import torch
from diffusers import AutoencoderKL, DDIMScheduler, DPMSolverMultistepScheduler, UNet2DConditionModel
from diffusers import StableDiffusionPipeline
from peft import LoraConfig
from peft.utils import get_peft_model_state_dict
from safetensors.torch import load_file, save_file
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

HERE = pathlib.Path(__file__).parent
TARGETS = ["to_q", "to_k", "to_v", "to_out.0"]

SMALL_UNET = dict(
    sample_size=8,
    block_out_channels=(16, 32, 32),
    layers_per_block=1,
    norm_num_groups=8,
    down_block_types=("CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
    up_block_types=("UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"),
)
SMALL_VAE = dict(block_out_channels=(8, 16), layers_per_block=1, norm_num_groups=4, sample_size=16)
FULL_VAE = dict(block_out_channels=(128, 256, 512, 512), layers_per_block=2, sample_size=512)
SMALL_TEXT = dict(vocab_size=700, intermediate_size=48, num_hidden_layers=2, num_attention_heads=4)

FAMILIES = {
    # 1x1 convolutions around the transformers, one head count, epsilon.
    "sd15": dict(
        unet=dict(in_channels=4, attention_head_dim=4, cross_attention_dim=24),
        text=dict(hidden_size=24, hidden_act="quick_gelu"),
        prediction="epsilon",
        full_unet=dict(sample_size=64, in_channels=4, attention_head_dim=8, cross_attention_dim=768),
        full_text=dict(hidden_size=768, intermediate_size=3072, num_hidden_layers=12, num_attention_heads=12, hidden_act="quick_gelu"),
    ),
    # Linear projections, heads by level, two transformer layers somewhere, v.
    "sd21": dict(
        unet=dict(in_channels=4, attention_head_dim=[2, 4, 8], cross_attention_dim=32, use_linear_projection=True, transformer_layers_per_block=[1, 2, 1]),
        text=dict(hidden_size=32, hidden_act="gelu"),
        prediction="v_prediction",
        full_unet=dict(sample_size=96, in_channels=4, attention_head_dim=[5, 10, 20, 20], cross_attention_dim=1024, use_linear_projection=True),
        full_text=dict(hidden_size=1024, intermediate_size=4096, num_hidden_layers=23, num_attention_heads=16, hidden_act="gelu"),
    ),
    # Nine input channels.
    "inpaint": dict(
        unet=dict(in_channels=9, attention_head_dim=[4, 4, 8], cross_attention_dim=32, use_linear_projection=True),
        text=dict(hidden_size=32, hidden_act="gelu"),
        prediction="epsilon",
        full_unet=dict(sample_size=64, in_channels=9, attention_head_dim=[5, 10, 20, 20], cross_attention_dim=1024, use_linear_projection=True),
        full_text=dict(hidden_size=1024, intermediate_size=4096, num_hidden_layers=23, num_attention_heads=16, hidden_act="gelu"),
    ),
    # Pooled text states that join the timestep: small models only.
    "pooled": dict(
        unet=dict(in_channels=4, attention_head_dim=4, cross_attention_dim=24, addition_embed_type="text", addition_embed_type_num_heads=4),
        text=dict(hidden_size=24, hidden_act="quick_gelu"),
        prediction="v_prediction",
    ),
}

PROMPTS = [
    "",
    "a photo of a car in a scene in the style of sks rendering",
    "  It's   a\tTEST, isn't it?  we're 12345 they'll; I'd\n",
    "crème brûlée — naïve café №5 ½",
    "日本語のテキスト 한국어 😀👍🏽 עברית",
    "e\u0301 A\u030a ﬁ ǅ İstanbul ß",
    "!!!??? --- ... <|endoftext|",
    "word " * 1000,
    "x" * 300,
]


def randomize(model, seed):
    """PyTorch's default initialisation leaves norms at 1 and 0: move them too."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, p in sorted(model.named_parameters()):
            noise = torch.randn(p.shape, generator=generator)
            if p.dim() > 1:
                fan_in = p[0].numel()
                p.copy_(noise / math.sqrt(fan_in))
            elif "norm" in name and name.endswith("weight"):
                p.copy_(1 + 0.1 * noise)
            else:
                p.copy_(0.1 * noise)
            p.copy_(p.half().float())
    return model


def write_tokenizer(folder, size):
    """The first merges of CLIP's vocabulary; `size` None for all of them."""
    package = importlib.util.find_spec("open_clip").submodule_search_locations[0]
    path = pathlib.Path(package) / "bpe_simple_vocab_16e6.txt.gz"
    merges = gzip.open(path).read().decode("utf-8").split("\n")[1 : 49152 - 256 - 2 + 1]
    # A printable character for every byte: itself, or one from 256 upwards.
    printable = [*range(33, 127), *range(161, 173), *range(174, 256)]
    others = [b for b in range(256) if b not in printable]
    symbols = [chr(b) for b in printable] + [chr(256 + i) for i in range(len(others))]
    if size is not None:
        merges = merges[: size - 2 * len(symbols) - 2]
    tokens = symbols + [s + "</w>" for s in symbols] + ["".join(m.split()) for m in merges]
    tokens += ["<|startoftext|>", "<|endoftext|>"]
    folder.mkdir(parents=True, exist_ok=True)
    vocab = {t: i for i, t in enumerate(tokens)}
    (folder / "vocab.json").write_text(json.dumps(vocab, ensure_ascii=False), encoding="utf-8")
    (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(merges) + "\n", encoding="utf-8")
    special = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "pad_token": "<|endoftext|>", "unk_token": "<|endoftext|>"}
    (folder / "special_tokens_map.json").write_text(json.dumps(special))
    (folder / "tokenizer_config.json").write_text(json.dumps({"model_max_length": 77, "tokenizer_class": "CLIPTokenizer"}))
    return CLIPTokenizer(vocab=vocab, merges=[tuple(m.split()) for m in merges], model_max_length=77)


def save_half(model, folder):
    model.half().save_pretrained(folder)
    model.float()


def lora_files(unet, folder, generator, results, inputs, small):
    config = LoraConfig(r=4, lora_alpha=6, target_modules=TARGETS)
    unet.requires_grad_(False)
    unet.add_adapter(config)
    with torch.no_grad():
        for name, p in sorted(unet.named_parameters()):
            if "lora_" in name:
                # As large as the small models' at any size: .2 = 1/sqrt(25). Larger ones saturate every
                # softmax, and then f32 does not hold the gradients to 1e-4, PyTorch's own included.
                scale = 0.2 if small or "lora_B" in name else 1 / math.sqrt(p[0].numel())
                p.copy_(torch.randn(p.shape, generator=generator) * scale)
    sample, t, context, noise = inputs
    out = unet(sample, t, context).sample
    results["lora_output"] = out.detach()
    loss = ((out - noise) ** 2).mean()
    loss.backward()
    results["lora_loss"] = loss.detach()[None]
    for name, p in unet.named_parameters():
        if "lora_" in name:
            name = name.replace(".default", "")
            if small or "mid_block" in name or "up_blocks.3.attentions.2" in name:
                results["grad." + name] = p.grad
    layers = get_peft_model_state_dict(unet)
    metadata = unet.peft_config["default"].to_dict()
    StableDiffusionPipeline.save_lora_weights(folder, unet_lora_layers=layers, unet_lora_adapter_metadata=metadata)
    (folder / "pytorch_lora_weights.safetensors").rename(folder / "lora_peft.safetensors")
    kohya = {}
    for key, value in layers.items():
        module = "lora_unet_" + key.rsplit(".lora_", 1)[0].replace(".", "_")
        which = "lora_down" if "lora_A" in key else "lora_up"
        kohya[f"{module}.{which}.weight"] = value.contiguous()
        kohya[f"{module}.alpha"] = torch.tensor(6.0)
    save_file(kohya, folder / "lora_kohya.safetensors")


def make(name, folder, full):
    family = FAMILIES[name]
    index = list(FAMILIES).index(name)
    generator = torch.Generator().manual_seed(100 + index)
    randn = lambda *shape: torch.randn(shape, generator=generator)
    results = {}

    text = dict(SMALL_TEXT, **family["text"]) if not full else family["full_text"]
    encoder = randomize(CLIPTextModel(CLIPTextConfig(**text)), 1).eval()
    save_half(encoder, folder / "text_encoder")
    if name == "sd15":
        # Published folders have the prefix that new exports lack.
        path = folder / "text_encoder" / "model.safetensors"
        state = load_file(path)
        save_file({k if k.startswith("text_model.") else "text_model." + k: v for k, v in state.items()}, path)
    tokenizer = write_tokenizer(folder / "tokenizer", None if full else SMALL_TEXT["vocab_size"])
    ids = tokenizer(PROMPTS, padding="max_length", truncation=True, max_length=77).input_ids
    (folder / "tokens.json").write_text(json.dumps([{"prompt": p, "ids": i} for p, i in zip(PROMPTS, ids)], ensure_ascii=False), encoding="utf-8")
    with torch.no_grad():
        states = encoder(torch.tensor(ids[1:3])).last_hidden_state
    results["text_states"] = states
    del encoder

    vae = randomize(AutoencoderKL(latent_channels=4, in_channels=3, out_channels=3,
        down_block_types=["DownEncoderBlock2D"] * (4 if full else 2), up_block_types=["UpDecoderBlock2D"] * (4 if full else 2),
        **(FULL_VAE if full else SMALL_VAE)), 2).eval()
    save_half(vae, folder / "vae")
    size = 256 if full else 16
    image = randn(1, 3, size, size).clamp(-1, 1).requires_grad_()
    posterior = vae.encode(image).latent_dist
    probe = randn(*posterior.mean.shape)
    (posterior.mean * probe).sum().backward()
    results |= dict(image=image.detach(), probe=probe, vae_mean=posterior.mean.detach(), vae_logvar=posterior.logvar.detach(), vae_image_grad=image.grad)
    z = randn(*posterior.mean.shape)
    with torch.no_grad():
        results |= dict(z=z, vae_decoded=vae.decode(z).sample)
    del vae

    unet = randomize(UNet2DConditionModel(**(family["full_unet"] if full else SMALL_UNET | family["unet"])), 3).eval()
    save_half(unet, folder / "unet")
    scheduler = dict(_class_name="DDIMScheduler", beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear",
        num_train_timesteps=1000, clip_sample=False, set_alpha_to_one=False, steps_offset=1, prediction_type=family["prediction"])
    (folder / "scheduler").mkdir(exist_ok=True)
    (folder / "scheduler" / "scheduler_config.json").write_text(json.dumps(scheduler, indent=1))
    (folder / "model_index.json").write_text(json.dumps({"_class_name": "StableDiffusionPipeline"}))
    side = 64 if full else 8
    sample = randn(2, unet.config.in_channels, side, side if full else 12)
    t = torch.tensor([7, 801])
    context = states * 1.0
    with torch.no_grad():
        results |= dict(sample=sample, timesteps=t.float(), context=context, unet_output=unet(sample, t, context).sample)
        # A size that is no multiple of 2^levels.
        odd = randn(1, unet.config.in_channels, 7, 5)
        results |= dict(odd_sample=odd, odd_output=unet(odd, 400, context[:1]).sample)
    noise = randn(*results["unet_output"].shape)
    results["noise"] = noise
    if full:
        torch.set_grad_enabled(True)
        unet.enable_gradient_checkpointing()
        unet.train()
    lora_files(unet, folder, generator, results, (sample, t, context, noise), not full)
    save_file({k: v.contiguous().float() for k, v in results.items()}, folder / "expected.safetensors")


def schedulers():
    """Every step of both samplers under several schedules, with model outputs drawn at random."""
    cases, tensors = [], {}
    base = dict(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", num_train_timesteps=1000)
    variants = {
        "sd_eps": dict(base, prediction_type="epsilon", steps_offset=1, timestep_spacing="leading"),
        "sd_v": dict(base, prediction_type="v_prediction", steps_offset=1, timestep_spacing="leading"),
        "linear_sample": dict(base, beta_start=1e-4, beta_end=0.02, beta_schedule="linear", prediction_type="sample", timestep_spacing="linspace"),
        "cosine_eps": dict(base, beta_schedule="squaredcos_cap_v2", prediction_type="epsilon", timestep_spacing="trailing"),
        "zero_snr_v": dict(base, prediction_type="v_prediction", rescale_betas_zero_snr=True, timestep_spacing="trailing"),
    }
    steps = 7
    for name, config in variants.items():
        for kind, cls, extra in [
            ("ddim", DDIMScheduler, dict(clip_sample=False, set_alpha_to_one=False)),
            ("dpm", DPMSolverMultistepScheduler, {}),
        ]:
            scheduler = cls(**config, **extra)
            scheduler.set_timesteps(steps)
            generator = torch.Generator().manual_seed(5)
            x = torch.randn(1, 2, 3, 3, generator=generator)
            outputs, states = [], [x]
            for t in scheduler.timesteps:
                output = torch.randn(x.shape, generator=generator)
                x = scheduler.step(output, t, x).prev_sample
                outputs.append(output)
                states.append(x)
            key = f"{name}.{kind}"
            tensors[f"{key}.outputs"] = torch.stack(outputs)
            tensors[f"{key}.states"] = torch.stack(states)
            tensors[f"{key}.alphas"] = scheduler.alphas_cumprod.float()
            cases.append(dict(key=key, kind=kind, steps=steps, timesteps=scheduler.timesteps.tolist(), config={**config, **extra}))
    (HERE / "schedulers.json").write_text(json.dumps(cases, indent=1))
    save_file({k: v.contiguous() for k, v in tensors.items()}, HERE / "schedulers.safetensors")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--full", nargs=2, metavar=("FAMILY", "FOLDER"))
    parser.add_argument("--only", choices=FAMILIES)
    arguments = parser.parse_args()
    if arguments.full:
        make(arguments.full[0], pathlib.Path(arguments.full[1]), True)
        return
    if arguments.only:
        make(arguments.only, HERE / arguments.only, False)
        return
    for name in FAMILIES:
        make(name, HERE / name, False)
    schedulers()


if __name__ == "__main__":
    main()
