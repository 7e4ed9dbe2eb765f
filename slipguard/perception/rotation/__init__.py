"""The rotation of a contact since the reference, with its sigma, or the reason why there is none.

`rotation_meter.RotationMeter` measures each contact. What it is put together from, in the order of its use:
    reference          which contact is the reference, and when a later one replaces it
    texture_map        the gel's curvature in a frame, by which textures are compared
    texture_tracker    follows the reference's texture from frame to frame
        texture_template, registration    the reference's texture; one registration to it, and its sigma
        rotation_curve, rotation_filter   which rotations look alike; which of them it is
        gel_memory                        correction for an earlier imprint that the gel still shows
    shift_meter        the shift of the object at the grasp axis
    axis, patch_axis, axial_angle, skeleton   the axis of the mask by the paper's estimators: orientation, comparison
"""
