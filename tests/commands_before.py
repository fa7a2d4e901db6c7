"""Commands, options and names of Python that older pages and scripts may have: what ``--help`` and ``__all__`` said.

Of release 0.1.0 (15b7a730: 11 commands, 102 options), and of the last state before the commands became ten (4c23ea8e:
16 commands, 169 options); each option once.
"""

_RECORDINGS = "--trajectories --observation"
_DOOR = (
    "--host --port --token-file --tls-certificate --tls-key --insecure --audit-file --max-clients"
    " --max-clients-per-address --max-requests-per-second --max-message-bytes"
)
_LOOP = "--control-hz --policy-hz --horizon --reserve --margin-ticks --threads --runtime --device"

BEFORE = {
    command: options.split()
    for command, options in {
        "bench": "--threads --runs --in-a-row --plan --runtime --device --precision --against --checkpoint --encoders"
        " --seed --json",
        "calibrate": f"{_RECORDINGS} --target-sparsity --target-flops --latency-ms --max-action-error --threads"
        " --strategy --correct --seed --max-minutes --device --resume --ray --json",
        "compare": f"{_RECORDINGS} --strategies --sparsities --with --calls --learned-calls --threads --max-minutes"
        " --correct --intervals --seed --ray --resume --plot --json",
        "convert": "--output --format --sampler --steps --spacing --task --encoders --without-camera"
        " --prediction-horizon --precision --keep-fp32 --single-file --explain --json",
        "distill": f"{_RECORDINGS} --plan --rank --updates --seed --max-minutes --device --resume --json",
        "doctor": "--json",
        "fleet": f"--ray --copies --threads --plan --batch --wait-ms --max-waiting {_DOOR}",
        "inspect": "--plot --plan --observation --json",
        "oracle": f"{_RECORDINGS} --computed-steps --schedules --calls --draws --seed --json",
        "push": "--evaluation --license --private --runs --dry-run",
        "realtime": f"{_LOOP} --plan --runs --jitter --json",
        "report": f"--output {_RECORDINGS} --episode --comparison --verify --threads --runtime --device --runs",
        "reuse-tokens": f"{_RECORDINGS} --calls --max-action-error --seed --off --json",
        "serve": f"{_LOOP} {_DOOR} --tier --seam --interpolation --max-hold --seed",
        "verify": f"{_RECORDINGS} --calls --threads --plot --json",
        "warm-start": f"{_RECORDINGS} --calls --max-distance --seed --off --json",
    }.items()
}

NAMES = frozenset(
    "Affine AsyncExecutor CallReport ChunkSpec CompiledPolicy EDMDenoiser ExecutorSettings GuardLimits Noise"
    " ObservationSpec PolicyInfo PolicySpec SamplerTable Source TtscompileError Verification __version__ calibrate"
    " compile_denoiser convert edm_table flow_matching_table legalize load push verify".split()
)
"""``ttscompile.__all__`` of release 0.1.0."""

LATER_NAMES = frozenset("TokenCalibration WarmCalibration distill reuse_tokens to_module warm_start".split())
"""What 4c23ea8e had beside these."""

USES = frozenset(
    "calibrate(strategy=) load(precision=) load(reuse_tokens=) load(warm=) PolicyInfo.warm_steps PolicySpec.original"
    " SamplerTable.without_skip".split()
)
"""Arguments and attributes of the names that are there still, which are gone."""
