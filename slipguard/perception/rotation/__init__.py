"""The rotation of a contact since the reference, with its sigma, or the reason why there is none.

`rotation_meter.RotationMeter` measures each contact. What it is put together from, in the order of its use:
    reference                                 which contact is the reference, and when a later one replaces it
    texture_map                               the gel's curvature in a frame, by which textures are compared
    segmented_texture                         whether the contact moves as a whole, so that the network may rest
    texture_tracker                           the texture since the reference, with key images in between
        texture_template, texture_registration    the reference's texture; one registration to it
        period_count                              which of the rotations that a periodic texture cannot distinguish
        gel_memory                                correction for an earlier imprint that the gel still shows
    contour_meter                             the contour since the reference
        contour_template, contour_registration    the reference's contour; one registration to it
        gel_contour                               contours that are the gel's own and never rotate
    axis, patch_axis, axial_angle, skeleton   the axis of a contact by four estimators
    round_contact                             which of these three a round contact rules out
    fusion                                    one rotation from texture, contour and axis
    lasting_twist                             a sigma that stays larger after the middle has rotated by itself
    rotation_tracker                          unwraps the rotation, declines implausible jumps, estimates the rate
    shift_meter                               the shift of the object at the grasp axis
"""
