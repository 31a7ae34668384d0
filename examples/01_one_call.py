"""From a folder of photographs to a textured mesh in one call.

    python examples/01_one_call.py [SCENE] [OUT.glb]

Without arguments the bundled sample is used.
"""

import sys
from pathlib import Path

import mvcore

SAMPLE = Path(mvcore.__file__).parent / "cli" / "sample"


def main(scene_path=SAMPLE, output="pickup.glb"):
    scene = mvcore.load(scene_path)
    result = mvcore.reconstruct(scene.frames, scene.calib)
    result.save(output)
    print(f"{output}: {len(result.faces)} faces; warnings: {result.warnings or 'none'}")


if __name__ == "__main__":
    main(*sys.argv[1:])
