"""The commands by name: one dict, from which help, completion and the command line itself are made."""

from __future__ import annotations

__all__ = ["COMMANDS"]

# name -> (module:function, or module:app for a command with commands of its own; what it does in one line)
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": (
        "beambox.cli.demo:command",
        "simulate a few sweeps, detect, score, draw: under a minute, nothing else needed",
    ),
    "setup": ("beambox.cli.setup:command", "compile kernels for this machine, so that the first detection is fast"),
    "detect": ("beambox.cli.detect:command", "find objects in sweeps: files, folders, patterns, recordings"),
    "show": ("beambox.cli.show:command", "draw sweeps in BEV, with boxes, and the boxes into the camera image"),
    "stream": ("beambox.cli.stream:command", "detect and track through a recording; boxes as a recording"),
    "serve": ("beambox.cli.serve:command", "detect over HTTP: POST a sweep, get JSON"),
    "track": ("beambox.cli.track:command", "follow objects through a drive: identities, velocities"),
    "view": ("beambox.cli.view:command", "sweeps, boxes and cameras in the rerun viewer, live or as a file"),
    "explain": ("beambox.cli.explain:command", "what the attention of HCNet, KASSD or DenNet looks at, as pictures"),
    "doctor": ("beambox.cli.doctor:command", "why does nothing work, or why are there no detections"),
    "models": ("beambox.cli.models:command", "the shipped weights and where they come from"),
    "simulate": ("beambox.cli.simulate:command", "write a labelled data set of simulated sweeps"),
    "recipes": ("beambox.cli.recipes:command", "the shipped recipes: for whom, how long, whether ever run"),
    "train": ("beambox.cli.train:command", "train a detector by a recipe"),
    "evaluate": ("beambox.cli.evaluate:command", "detect in a labelled data set and score by KITTI's rules"),
    "report": ("beambox.cli.report:command", "one page per evaluation: curves, errors, worst failures as pictures"),
    "ablate": ("beambox.cli.ablate:command", "train and score the rows of a paper's table; print ours beside theirs"),
    "data": ("beambox.cli.data:app", "check a data set of one's own before training, and propose anchors for it"),
    "bench": ("beambox.cli.bench:command", "latency stage by stage, throughput, peak memory"),
    "submit": ("beambox.cli.submit:command", "check result files for KITTI's test server and pack them"),
    "export": ("beambox.cli.export:command", "write a detector as an ONNX file, compared with PyTorch"),
    "completion": ("beambox.cli.completion:command", "a script that completes commands and options in a shell"),
    "import-openpcdet": ("beambox.cli.import_openpcdet:command", "convert a checkpoint of OpenPCDet"),
    "score": ("beambox.cli.score:app", "score result files of any detector by the rules of KITTI or ONCE"),
}
