"""Made-up records of servo episodes."""

from planning.episode import Record


def record(model, setup=0, share=0.5, space3d=False, space2d=False, final=0.1, pixels=1.0, repeat=0):
    """An episode that reached its goal, or did not, in space and in the picture."""
    return Record(
        model=model,
        setup=setup,
        repeat=repeat,
        steps=9,
        initial_distance=0.3,
        initial_pixel_distance=20.0,
        axis_share=share,
        hits_3d=[5 * space3d, 0, 0],
        hits_2d=[5 * space2d, 0, 0],
        final_distance=final,
        final_pixel_distance=pixels,
        least_distance=final,
        plan_seconds=0.1,
        distances=[final],
    )
