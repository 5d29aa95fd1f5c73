"""Draw docs/images/robots.png, all models of arms at one scale: MUJOCO_GL=egl python docs/contact_sheet.py."""

from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.kinematics.robots import ROBOTS

WIDTH, HEIGHT, COLUMNS = 200, 230, 7
POSE_RAD = (0.0, -1.75, 1.6, -1.42, -1.57, 0.0)
BACKGROUND = (255, 255, 255)


def tile(robot: str) -> Image.Image:
    """Return the picture of one arm in a bent pose, seen from the side."""
    mounts = ArmMount((0.0, 0.0, 0.0), 0.0, robot=robot), ArmMount((0.0, -3.0, 0.0), 0.0, robot=robot)
    settings = SceneSettings(left=mounts[0], right=mounts[1], table_center_m=(2.9, 2.9), table_size_m=(0.1, 0.1))
    model = build_model(settings)
    model.geom_rgba[model.geom("floor").id, 3] = 0.0
    model.vis.global_.offwidth, model.vis.global_.offheight = 2 * WIDTH, 2 * HEIGHT
    data = mujoco.MjData(model)
    data.qpos[:6] = POSE_RAD
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.36, 0.0, 0.66), 2.15, 115.0, -8.0
    with mujoco.Renderer(model, 2 * HEIGHT, 2 * WIDTH) as renderer:
        renderer.update_scene(data, camera)
        picture = Image.fromarray(renderer.render())
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera)
        geoms = renderer.render()[..., 0]
    arm = np.array([model.geom_bodyid[geom] > 0 and geom >= 0 for geom in range(model.ngeom)])
    mask = np.where(geoms >= 0, arm[np.maximum(geoms, 0)], False)
    cut = Image.composite(picture, Image.new("RGB", picture.size, BACKGROUND), Image.fromarray(mask))
    return cut.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    rows = -(-len(ROBOTS) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * WIDTH, rows * HEIGHT), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for index, (name, facts) in enumerate(ROBOTS.items()):
        corner = index % COLUMNS * WIDTH, index // COLUMNS * HEIGHT
        sheet.paste(tile(name), corner)
        draw.text((corner[0] + 8, corner[1] + 6), facts.title, fill=(40, 40, 40), font=ImageFont.load_default(18))
    path = Path(__file__).parent / "images" / "robots.png"
    sheet.quantize(128).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")
