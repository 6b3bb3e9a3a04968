"""The parts in C; pyproject.toml has everything else.

Where nothing can compile them, SciPy, torch and numpy do the same at several times the cost.
"""

from setuptools import Extension, setup

FLAGS = [
    "-O3",
    "-fvisibility=hidden",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-freciprocal-math",
]
GEOMETRY, CHANNELS = "src/pcdenoise/cloud/geometry.h", "src/pcdenoise/networks/channels.h"
HEADERS = {
    "cloud/neighbours": [GEOMETRY],
    "denoising/relaxation": [GEOMETRY],
    "networks/fused": [GEOMETRY, CHANNELS],
    "networks/exchange": [GEOMETRY, CHANNELS],
}

setup(
    ext_modules=[
        Extension(
            "pcdenoise." + "._".join(part.split("/")),
            [f"src/pcdenoise/{part}.c"],
            depends=headers,
            optional=True,
            extra_compile_args=FLAGS,
        )
        for part, headers in HEADERS.items()
    ]
)
