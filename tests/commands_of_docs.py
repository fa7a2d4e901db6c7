"""The commands on the pages: which are not run by the tests, and what makes the others short."""

from __future__ import annotations

NOT_RUN = {
    "make": "sets up an environment; what it runs then are CI's own steps, and examples/pusht/demo.py",
    "pip install": "would change the environment of this run",
    "git clone": "there is no network",
    "source": "of the shell, and for what make would have set up",
    "cd": "of the shell",
    "python examples/benchmark/sweep.py": "takes 20 minutes; tests/examples/test_benchmark_sweep.py runs it in short",
    "python examples/benchmark/rivals.py": "tests/examples/test_benchmark_rivals.py runs it in short",
    "python examples/ablation/oracle.py": "tests/examples/test_ablation_oracle.py runs it in short",
    "python examples/benchmark/gpu.py": "needs a GPU; tests/examples/test_benchmark_gpu.py runs it on the CPU",
    "pytest tests/runtimes/test_cuda.py": "needs a GPU",
    "python examples/evaluation/warm_start.py": "takes minutes; tests/examples has it in short",
    ".venv/bin/pytest": "a part of this suite, or of the test of the guide's own files",
    ".venv/bin/ruff": "make lint",
    "ttscompile build trained/": "of two cameras: minutes; tests/test_builder.py builds smaller ones",
    "ttscompile build outputs/": "the same",
    "ttscompile bench compiled/ --choose": "needs plans that are near; tests/cli/test_choosing.py runs it",
    "ttscompile serve": "has no end; tests/serving and tests/serving start it",
    "ttscompile calibrate own/": "a short search ends with 1; tests/calibration/proposers/test_loops.py runs it",
    "ttscompile calibrate compiled/ --trajectories calls.npz --learn tokens": "needs tokens: tests/calibration",
    "ttscompile calibrate compiled/ --trajectories calls.npz --learn schedule,start": "a short search ends with 1",
    "ttscompile calibrate compiled/ --trajectories calls.npz --target-sparsity 0.875 --learn": "the same",
    "curl": "needs a server; tests/serving/test_metrics.py and tests/serving ask the same of one",
    "python examples/serve": "needs a server; the same tests run it against one",
    "ttscompile convert hf://": "from the hub: tests/hub",
    "ttscompile push compiled/ org/compiled-policy --private": "to the hub: tests/hub",
    "lerobot-": "a command of LeRobot: tests/plugins runs it, where lerobot is installed",
    "python -m lerobot_policy_ttscompile": "the same",
    "ttscompile convert rdt-1b/": "RDT-1B's directory: tests/policies converts a small one",
    "ttscompile convert CogACT-Base/": "CogACT's checkpoint: the same of a small one",
    "ttscompile convert octo-small-1.5/": "Octo's folder: tests/policies converts small ones",
    "ttscompile convert openpi/": "openpi's folder: the same",
    "ttscompile convert authors/": "what others' code saved: tests/policies writes the same, and converts it",
    "ttscompile convert hybridvla/": "HybridVLA's checkpoint: tests/policies converts a small one",
    "ttscompile convert claw.pt": "Diffusion BC's weights: the same of small ones",
    "ttscompile convert run/": "DPPO's weights and configuration: the same of small ones",
    "ttscompile convert pretrained_model": "a LeRobot policy, with --task: tests/policies/test_lerobot.py",
    "MUJOCO_GL=osmesa python": "in MuJoCo: tests/examples/test_environments.py has its worlds",
    "ttscompile calibrate compiled/ --trajectories calls.npz --ray": "of Ray: tests/calibration/test_pool.py",
    "ttscompile calibrate compiled/ --trajectories lerobot": "of LeRobot: tests/trajectories/test_recordings.py",
}
"""How the commands begin that are not run here, and why. Every other one is run; of these the options are checked."""

SHORTER = {
    "build": "--minutes 0.01 --error 9",
    "convert": "--steps 5",
    "calibrate": "--target-sparsity 0.8 --max-minutes 0.001",
    "bench": "--calls 1",
    "record.py": "--episodes 2 --threads 1",
    "evaluate.py": "--episodes 1 --threads 1",
}
"""Options that are added to what is shown, so that it takes seconds: five denoising steps, of which one is computed."""
