"""A llama.cpp server in a process of its own, with a model of two layers and random weights. Wants xllamacpp and gguf.

usage: python llama_samples.py CONTEXT SEED FOLDER    (prints its address, and serves until its standard input ends)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

EMBEDDING, FORWARD, HEADS, LAYERS = 64, 128, 4, 2
TRAINED_ON = 32_768  # tokens: the context that the model's file names
PIECES = [f"▁{word}" for word in ("road", "the", "a", "ego", "bv")]
BYTES = [f"<0x{k:02X}>" for k in range(256)]
LETTERS = [chr(k) for k in range(33, 127)]


def write_model(path: Path, seed: int) -> None:
    """A model of llama's kind that says random things. Its tokens are bytes, characters and a few words."""
    import gguf

    rng = np.random.default_rng(seed)
    tokens = ["<unk>", "<s>", "</s>", *BYTES, "▁", *LETTERS, *PIECES]
    kinds = [2, 3, 3, *[6] * len(BYTES), *[1] * (1 + len(LETTERS) + len(PIECES))]  # unknown, control, byte, normal
    writer = gguf.GGUFWriter(str(path), "llama")
    writer.add_context_length(TRAINED_ON)
    writer.add_embedding_length(EMBEDDING)
    writer.add_block_count(LAYERS)
    writer.add_feed_forward_length(FORWARD)
    writer.add_head_count(HEADS)
    writer.add_head_count_kv(HEADS)
    writer.add_layer_norm_rms_eps(1e-5)
    writer.add_rope_dimension_count(EMBEDDING // HEADS)
    writer.add_vocab_size(len(tokens))
    writer.add_tokenizer_model("llama")
    writer.add_token_list(tokens)
    writer.add_token_scores([-float(k) for k in range(len(tokens))])
    writer.add_token_types(kinds)
    writer.add_bos_token_id(1)
    writer.add_eos_token_id(2)
    writer.add_unk_token_id(0)

    def tensor(name: str, *shape: int) -> None:
        writer.add_tensor(name, rng.normal(0.0, 0.2, shape).astype(np.float32))

    tensor("token_embd.weight", len(tokens), EMBEDDING)
    tensor("output.weight", len(tokens), EMBEDDING)
    tensor("output_norm.weight", EMBEDDING)
    for k in range(LAYERS):
        for name in ("attn_q", "attn_k", "attn_v", "attn_output"):
            tensor(f"blk.{k}.{name}.weight", EMBEDDING, EMBEDDING)
        tensor(f"blk.{k}.ffn_gate.weight", FORWARD, EMBEDDING)
        tensor(f"blk.{k}.ffn_up.weight", FORWARD, EMBEDDING)
        tensor(f"blk.{k}.ffn_down.weight", EMBEDDING, FORWARD)
        tensor(f"blk.{k}.attn_norm.weight", EMBEDDING)
        tensor(f"blk.{k}.ffn_norm.weight", EMBEDDING)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


def main() -> None:
    """Serve until standard input ends."""
    import xllamacpp

    context, seed, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    model = folder / "random.gguf"
    write_model(model, seed)
    given = xllamacpp.CommonParams()
    given.model.path = str(model)
    given.n_ctx, given.n_parallel, given.port, given.hostnames = context, 1, 0, ["127.0.0.1"]
    given.cpuparams.n_threads, given.warmup, given.chat_template = 1, False, "chatml"
    server = xllamacpp.Server(given)
    print(server.listening_address, flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
