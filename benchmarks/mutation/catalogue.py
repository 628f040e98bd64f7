"""The mistakes: one or more for every convention and formula of the chain that is easy to get wrong."""

from __future__ import annotations

from benchmarks.mutation.planting import Mistake


def _in(file: str, *mistakes: tuple[str, str, str, str]) -> list[Mistake]:
    """Mistakes of one file below mi_refgs: name, before, after, and the test below tests."""
    return [
        Mistake(name, f"mi_refgs/{file}", before, after, f"tests/{test}")
        for name, before, after, test in mistakes
    ]


_CONSTANTS = _in(
    "constants.py",
    (
        "facing: normals are never turned to the camera",
        "FACING_TOLERANCE = 0.25",
        "FACING_TOLERANCE = 2.0",
        "test_pipeline.py::test_normals_are_turned_to_the_camera_unless_they_only_lean_away",
    ),
    (
        "footprint: low-pass of a variance of ½, not 1/12",
        "LOW_PASS_INV_VARIANCE = 12.0",
        "LOW_PASS_INV_VARIANCE = 2.0",
        "test_pipeline.py::test_opacity_and_the_size_on_screen_have_their_bounds",
    ),
)

_FOOTPRINT = _in(
    "primitives/surfel.py",
    (
        "footprint: standard deviations of u and v swapped",
        "of_u, of_v = inverse / s.x, inverse / s.y",
        "of_u, of_v = inverse / s.y, inverse / s.x",
        "test_splat.py::test_image_matches_oracle",
    ),
    (
        "footprint: sign of b",
        "[-of_v * along_u.y / focal.x",
        "[of_v * along_u.y / focal.x",
        "test_splat.py::test_image_matches_oracle",
    ),
    (
        "footprint: samples before the near plane count",
        "(alpha >= ALPHA_MIN) & (z > near)",
        "(alpha >= ALPHA_MIN) & (z == z)",
        "test_pipeline.py::test_samples_before_the_near_plane_are_cut",
    ),
    (
        "footprint: edge-on surfels go too early",
        "> EDGE_ON_COSINE * dr.sqrt",
        "> 1000 * EDGE_ON_COSINE * dr.sqrt",
        "test_splat.py::test_image_matches_oracle",
    ),
    (
        "footprint: rectangle too small",
        "half = half * 1.0001 + 1e-3",
        "half = half * 0.8",
        "test_splat.py::test_tile_lists_hold_what_contributes_and_little_else",
    ),
    (
        "footprint: the larger of plane and low-pass",
        "(rho_screen < rho_plane)",
        "(rho_screen > rho_plane)",
        "test_splat.py::test_image_matches_oracle",
    ),
    (
        "footprint: no clamp at the largest opacity",
        "alpha = dr.select(clamped, ALPHA_MAX, alpha)",
        "alpha = dr.select(clamped, alpha, alpha)",
        "test_splat.py::test_image_matches_oracle",
    ),
    (
        "footprint: gradient through the clamp",
        "δalpha = dr.select(sample.clamped, 0, δalpha)",
        "δalpha = dr.select(sample.clamped, δalpha, δalpha)",
        "test_splat.py::test_gradients_match_the_oracle",
    ),
    (
        "footprint: four times the α cut",
        "(alpha >= ALPHA_MIN) & (z",
        "(alpha >= 4 * ALPHA_MIN) & (z",
        "test_splat.py::test_image_matches_oracle",
    ),
    (
        "sort: by depth of the centres",
        "dr.fma(inside, linear(c_x, c_y, delta), 1)",
        "dr.fma(0 * inside, linear(c_x, c_y, delta), 1)",
        "test_splat.py::test_tile_lists_are_in_the_oracles_order",
    ),
    (
        "tiles: overlaps too tight",
        "r2 = reach(opacity) * 1.0005 + 1e-4",
        "r2 = reach(opacity) * 0.7",
        "test_splat.py::test_tile_lists_hold_what_contributes_and_little_else",
    ),
    (
        "adjoint: opacity",
        "dr.fma(δalpha, sample.gaussian, self.opacity)",
        "dr.fma(δalpha, sample.alpha, self.opacity)",
        "test_splat.py::test_gradients_match_the_oracle",
    ),
    (
        "adjoint: the centre moves no depth",
        "b[0] * row[2 + i] + c[0] * row[4 + i]",
        "b[0] * row[2 + i]",
        "test_splat.py::test_gradients_match_the_oracle",
    ),
    (
        "adjoint: half the low-pass",
        "dr.fma(LOW_PASS_INV_VARIANCE, screen,",
        "dr.fma(0.5 * LOW_PASS_INV_VARIANCE, screen,",
        "test_splat.py::test_gradients_match_the_oracle",
    ),
    (
        "tangent: sign of the Gaussian",
        "sample.gaussian - 0.5 * sample.alpha * drho",
        "sample.gaussian + 0.5 * sample.alpha * drho",
        "test_splat.py::test_forward_mode_is_the_transpose_of_reverse",
    ),
)

_TILES = _in(
    "splat/tiles.py",
    (
        "sort: farthest first",
        "key = (key - least) >>",
        "key = (dr.max(key) - key) >>",
        "test_splat.py::test_tile_lists_are_in_the_oracles_order",
    ),
    (
        "sort: the upper digit is lost",
        "for digit in range(3)",
        "for digit in range(2)",
        "test_splat.py::test_tile_lists_are_in_the_oracles_order",
    ),
    (
        "tiles: a column short",
        "span = mi.UInt32(last[0] - first[0] + 1)",
        "span = mi.UInt32(dr.maximum(last[0] - first[0], 1))",
        "test_splat.py::test_tile_lists_hold_what_contributes_and_little_else",
    ),
)

_BLEND = _in(
    "splat/blend.py",
    (
        "blend: ends ten times too early",
        "(after < TRANSMITTANCE_MIN)",
        "(after < 10 * TRANSMITTANCE_MIN)",
        "test_pipeline.py::test_layers_show_down_to_the_least_transmittance",
    ),
    (
        "adjoint: opacity hides nothing behind it",
        "dr.fma(transmittance, g, -rest / (1 - sample.alpha))",
        "transmittance * g",
        "test_splat.py::test_gradients_match_the_oracle",
    ),
    (
        "adjoint: features of the last block alone",
        "δfeature = dr.fma(weight, δhere[k], δfeature)",
        "δfeature = weight * δhere[k]",
        "test_splat.py::test_gradients_match_the_oracle",
    ),
    (
        "adjoint: depth gets that of alpha",
        "geometry.add(sample, δalpha, weight * δhere[-2])",
        "geometry.add(sample, δalpha, weight * δhere[-1])",
        "test_splat.py::test_gradients_match_the_oracle",
    ),
    (
        "tangent: transmittance has none",
        "dtransmittance * sample.alpha + transmittance * dalpha",
        "transmittance * dalpha",
        "test_splat.py::test_forward_mode_is_the_transpose_of_reverse",
    ),
)

_CAMERA = _in(
    "splat/camera.py",
    (
        "camera: pixel centres at their corners",
        "index % self.width + 0.5, index // self.width + 0.5",
        "index % self.width + 0.0, index // self.width + 0.0",
        "test_dataset.py::test_depth_and_normals_lie_on_the_sphere",
    ),
    (
        "plugin: a crop window has tiles of its own",
        "return replace(camera, offset=(x, y))",
        "return replace(camera, offset=(0 * x, 0 * y))",
        "test_integrator_images.py::test_crop_window_is_part_of_the_whole",
    ),
)

_PIPELINE = _in(
    "render/pipeline.py",
    (
        "facing: turned away",
        "> FACING_TOLERANCE, -normal, normal",
        "> FACING_TOLERANCE, normal, -normal",
        "test_pipeline.py::test_normals_are_turned_to_the_camera_unless_they_only_lean_away",
    ),
    (
        "alpha: pixels are shaded with materials not divided by it",
        "mi.Color3f(*(x * inverse for x in features[0:3]))",
        "mi.Color3f(*(x for x in features[0:3]))",
        "test_pipeline.py::test_pixels_are_shaded_by_the_oracle",
    ),
    (
        "alpha: shaded pixels are not multiplied by it",
        "Terms(*(term * blended.alpha for term in",
        "Terms(*(1 * term for term in",
        "test_pipeline.py::test_pixels_are_shaded_by_the_oracle",
    ),
    (
        "harmonics: colour without its ½",
        "eval_sh(coefficients, direction) + 0.5",
        "eval_sh(coefficients, direction)",
        "test_pipeline.py::test_colour_of_harmonics_up_to_a_degree",
    ),
    (
        "harmonics: the limit of the degree is ignored",
        "coefficients = coefficients[: (sh_degree + 1) ** 2]",
        "coefficients = coefficients[:]",
        "test_pipeline.py::test_colour_of_harmonics_up_to_a_degree",
    ),
)

_RENDER = [
    *_in(
        "render/depth_normals.py",
        (
            "depth normals: edges are slopes",
            "DEPTH_EDGE_COSINE = 0.2",
            "DEPTH_EDGE_COSINE = 0.0",
            "test_depth_normals.py::test_steps_between_surfaces_have_no_normal",
        ),
        (
            "depth normals: away from the camera",
            "dr.select(cosine > 0, -normal, normal)",
            "dr.select(cosine > 0, normal, -normal)",
            "test_depth_normals.py::test_depth_normals_of_a_plane_are_exact",
        ),
    ),
    *_in(
        "render/reflection.py",
        (
            "traced light: a bounce is missing",
            "if bounces == 1:",
            "if bounces <= 2:",
            "test_traced_light.py::test_bounces_of_a_mirror_ray_against_the_oracle",
        ),
    ),
    *_in(
        "render/scene_xml.py",
        (
            "scene.xml: field of view along y",
            '"fov_axis", "x"',
            '"fov_axis", "y"',
            "test_integrator.py::test_exported_scene_renders_the_same_view",
        ),
        (
            "scene.xml: options of accuracy are left out",
            "if value != option.default",
            "if value == option.default",
            "test_scene_xml.py::test_every_option_of_accuracy_goes_round",
        ),
        (
            "scene.xml: sign of the principal point",
            "repr(0.5 - cx * per_pixel[0] / width)",
            "repr(cx * per_pixel[0] / width - 0.5)",
            "test_integrator.py::test_exported_scene_renders_the_same_view",
        ),
    ),
]

_SHADE = [
    *_in(
        "shade/brdf.py",
        (
            "split sum: axes of the table swapped",
            "texel = row * RESOLUTION + column",
            "texel = column * RESOLUTION + row",
            "test_brdf.py::test_texel_centres_and_axes",
        ),
        (
            "split sum: Schlick's power is 4",
            "schlick = (1 - v_h) ** 5",
            "schlick = (1 - v_h) ** 4",
            "test_brdf.py::test_the_cached_table_is_the_one_that_this_code_computes",
        ),
    ),
    *_in(
        "shade/envmap.py",
        (
            "light: mirrored in x",
            "dr.atan2(dr.select(off_pole, x, 0)",
            "dr.atan2(dr.select(off_pole, -x, 0)",
            "test_envmap.py::test_mirror_is_mitsubas_envmap",
        ),
        (
            "light: turned by 90°",
            "u = φ * (0.5 / dr.pi)",
            "u = φ * (0.5 / dr.pi) - 0.25",
            "test_envmap.py::test_mirror_is_mitsubas_envmap",
        ),
        (
            "light: half a texel off",
            "dr.fma(u, mi.Float(w), -0.5)",
            "dr.fma(u, mi.Float(w), 0)",
            "test_envmap.py::test_mirror_is_mitsubas_envmap",
        ),
        (
            "light: half a row off",
            "v * mi.Float(h - 1)",
            "dr.maximum(v * mi.Float(h) - 0.5, 0)",
            "test_envmap.py::test_mirror_is_mitsubas_envmap",
        ),
        (
            "light: irradiance is the level before the last",
            "mi.UInt32(len(lobe_matrices.LEVEL_ROUGHNESS)))",
            "mi.UInt32(len(lobe_matrices.LEVEL_ROUGHNESS) - 1))",
            "test_envmap.py::test_irradiance_is_the_cosine_integral",
        ),
        (
            "light: levels mixed by roughness squared below the first",
            "level = dr.square(dr.square(sharp))",
            "level = dr.square(sharp)",
            "test_envmap.py::test_specular_against_the_oracle",
        ),
    ),
    *_in(
        "shade/lobe_matrices.py",
        (
            "prefilter: texels at the poles weigh as others",
            "@ transform * np.sin(θ[near])[:, None]",
            "@ transform",
            "test_envmap.py::test_levels_against_brute_force",
        ),
    ),
    *_in(
        "shade/prefilter.py",
        (
            "prefilter: the map itself gets no gradient",
            "dr.gather(mi.Float, out, texel) + dr.gather(mi.Float, δlevels, texel)",
            "dr.gather(mi.Float, out, texel)",
            "test_envmap.py::test_prefilter_adjoint_and_tangent",
        ),
    ),
    *_in(
        "shade/models.py",
        (
            "materials: F0 of a dielectric is 0.08",
            "DIELECTRIC_F0 = 0.04",
            "DIELECTRIC_F0 = 0.08",
            "test_models.py::test_terms_against_the_oracle",
        ),
        (
            "materials: metals keep a dielectric's F0",
            "dr.fma(points.albedo - DIELECTRIC_F0, points.metallic",
            "dr.fma(points.albedo, points.metallic",
            "test_models.py::test_terms_against_the_oracle",
        ),
        (
            "materials: metals have a diffuse part",
            "(1 - points.metallic) * points.radiance",
            "1 * points.radiance",
            "test_models.py::test_terms_against_the_oracle",
        ),
        (
            "materials: reflected to the other side",
            "dr.fma(2 * dr.dot(normal, view), normal, -view)",
            "dr.fma(-2 * dr.dot(normal, view), normal, view)",
            "test_models.py::test_mirror_direction",
        ),
    ),
    *_in(
        "shade/sh.py",
        (
            "harmonics: signs of degree 1",
            "basis += [-k * y, k * z, -k * x]",
            "basis += [k * y, k * z, k * x]",
            "test_sh.py::test_degree_one_signs",
        ),
    ),
]

_OCCLUSION = [
    *_in(
        "occlusion/visibility.py",
        (
            "visibility: rays start below the surface",
            "mi.Vector3f(origin) + offset * away",
            "mi.Vector3f(origin) - offset * away",
            "test_visibility.py::test_mirror_rays_against_the_true_shape",
        ),
        (
            "visibility: a tenth of the offset",
            "OFFSET_VOXELS = 2.0",
            "OFFSET_VOXELS = 0.2",
            "test_visibility.py::test_mirror_rays_against_the_true_shape",
        ),
    ),
    *_in(
        "occlusion/tsdf.py",
        (
            "mesh: sign of the distance",
            "distance = near - point.z",
            "distance = point.z - near",
            "test_tsdf.py::test_surface_is_closed_outward_and_within_a_voxel",
        ),
        (
            "mesh: depth read half a pixel off",
            "px = point.x * inv_z * camera.fx + camera.cx - 0.5",
            "px = point.x * inv_z * camera.fx + camera.cx",
            "test_tsdf.py::test_matches_the_float64_specification",
        ),
    ),
    *_in(
        "occlusion/mesh.py",
        (
            "mesh: triangles wind inward",
            'gradient_direction="descent"',
            'gradient_direction="ascent"',
            "test_tsdf.py::test_surface_is_closed_outward_and_within_a_voxel",
        ),
    ),
]

_LOSSES = [
    *_in(
        "images.py",
        (
            "sRGB: joint of line and curve",
            "SRGB_ENCODED_LIMIT = 0.04045",
            "SRGB_ENCODED_LIMIT = 0.4045",
            "test_images.py::test_srgb_curve",
        ),
    ),
    *_in(
        "render/display.py",
        (
            "sRGB: exponent 2.2",
            "linear), 1 / 2.4) - 0.055",
            "linear), 1 / 2.2) - 0.055",
            "test_losses.py::test_srgb_matches_the_file_reader_and_has_a_slope_at_zero",
        ),
        (
            "sRGB: slope at zero",
            "12.92 * linear, curve)",
            "12.0 * linear, curve)",
            "test_losses.py::test_srgb_matches_the_file_reader_and_has_a_slope_at_zero",
        ),
        (
            "sRGB: composited before it is encoded",
            "alpha * srgb_from_linear(plane * inverse) + (1 - alpha) * behind",
            "srgb_from_linear(plane + (1 - alpha) * behind)",
            "test_losses.py::test_display_image",
        ),
        (
            "alpha: display divides by it twice",
            "srgb_from_linear(plane * inverse)",
            "srgb_from_linear(plane * inverse * inverse)",
            "test_losses.py::test_display_image",
        ),
    ),
    *_in(
        "fit/losses.py",
        (
            "loss: a white background counts as a highlight",
            "plane - (1 - alpha) * behind >= SATURATED * alpha",
            "plane >= SATURATED",
            "test_losses.py::test_only_the_objects_own_colour_is_a_highlight",
        ),
        (
            "loss: highlights are clipped everywhere",
            "dr.select(mask & (plane > goal)",
            "dr.select((plane > goal)",
            "test_losses.py::test_l1_of_clipped_highlights",
        ),
        (
            "loss: normals do not move the depth",
            "mi.Vector3f(depth_normal)))",
            "dr.detach(mi.Vector3f(depth_normal))))",
            "test_depth_normals.py::test_normal_consistency_through_the_depth",
        ),
    ),
    *_in(
        "fit/objective.py",
        (
            "sRGB: 8-bit targets are encoded again",
            "for plane in planes] if view.linear else planes",
            "for plane in planes] if not view.linear else planes",
            "test_objective.py::test_a_perfect_picture_costs_nothing",
        ),
        (
            "loss: L1 keeps its whole weight beside SSIM",
            "(1 - weights.ssim) * losses.l1",
            "losses.l1",
            "test_objective.py::test_terms_are_weighed_as_the_method_says",
        ),
        (
            "loss: alpha is not weighed",
            "weights.alpha * losses.alpha_loss",
            "losses.alpha_loss",
            "test_objective.py::test_terms_are_weighed_as_the_method_says",
        ),
    ),
]

_OPTIMISER = [
    *_in(
        "fit/optim.py",
        (
            "Adam: no bias correction",
            "math.sqrt(1 - BETA_2**t) / (1 - BETA_1**t)",
            "1.0",
            "test_optim.py::test_equals_the_published_algorithm",
        ),
        (
            "Adam: ε of 1e-8",
            "EPSILON = 1e-15",
            "EPSILON = 1e-8",
            "test_optim.py::test_equals_the_published_algorithm",
        ),
        (
            "Adam: moments stay when rows move",
            "rows = gather_rows(old, parent).array",
            "rows = gather_rows(old, dr.minimum(dr.arange(mi.UInt32, len(parent)), old.shape[0] - 1)).array",
            "test_optim.py::test_moments_follow_their_rows",
        ),
        (
            "Adam: rates rise instead of falling",
            "(1 - progress) * math.log(self.rate) + progress * math.log(self.final)",
            "progress * math.log(self.rate) + (1 - progress) * math.log(self.final)",
            "test_optim.py::test_group_rates",
        ),
        (
            "resume: second moments are the first ones",
            '(("first", self._first), ("second", self._second))',
            '(("first", self._first), ("first", self._second))',
            "test_optim.py::test_resume_is_bitwise",
        ),
    ),
    *_in(
        "primitives/primitive.py",
        (
            "split: children leave their parent's plane",
            "2 * (x * y + z * w), 2 * (x * z - y * w)]",
            "2 * (x * y + z * w), 2 * (x * z + y * w)]",
            "test_refine.py::test_large_hot_surfels_are_split_within_their_own_plane",
        ),
    ),
    *_in(
        "fit/refine.py",
        (
            "split: children are larger",
            "children, 1 / SPLIT_SHRINK)",
            "children, SPLIT_SHRINK)",
            "test_refine.py::test_large_hot_surfels_are_split_within_their_own_plane",
        ),
        (
            "prune: size is compared in scene units",
            "options.prune_extent * extent",
            "options.prune_extent",
            "test_refine.py::test_sizes_are_shares_of_the_scene",
        ),
        (
            "split: size is compared in scene units",
            "options.dense_extent * extent",
            "options.dense_extent",
            "test_refine.py::test_sizes_are_shares_of_the_scene",
        ),
        (
            "reset: opacities are raised",
            'np.minimum(raw["opacity"]',
            'np.maximum(raw["opacity"]',
            "test_refine.py::test_reset_lowers_opacity_and_lifts_metallic_only",
        ),
    ),
    *_in(
        "fit/train.py",
        (
            "reset: moments stay",
            "self.optimiser.reset(name)",
            "self.optimiser.rate(name, 0)",
            "test_train.py::test_an_edit_clears_the_moments_of_what_it_changed",
        ),
        (
            "densify: gradient in pixels",
            "mi.Vector2f(0.5 * camera.width, 0.5 * camera.height)",
            "mi.Vector2f(1.0, 1.0)",
            "test_train.py::test_the_screen_gradient_is_in_half_pictures",
        ),
        (
            "resume: an iteration is repeated",
            'self.iteration, self.seconds = int(state["iteration"])',
            'self.iteration, self.seconds = int(state["iteration"]) - 1',
            "test_train.py::test_resume_repeats_a_straight_run_bit_for_bit",
        ),
        (
            "resume: opacities learn too early",
            'self.held_until = int(state["held_until"])',
            "self.held_until = 0",
            "test_train.py::test_resume_repeats_a_straight_run_bit_for_bit",
        ),
    ),
    *_in(
        "fit/schedule.py",
        (
            "schedule: every epoch has one order of views",
            "[self.method.seed, epoch, 1]",
            "[self.method.seed, 0 * epoch, 1]",
            "test_schedule.py::test_views_come_once_an_epoch_in_an_order_of_its_own",
        ),
        (
            "schedule: the seed changes nothing",
            "np.random.default_rng([self.method.seed, iteration])",
            "np.random.default_rng([iteration])",
            "test_schedule.py::test_draws_follow_seed_and_iteration",
        ),
        (
            "schedule: degree raised a step late",
            "sh_raise.count(iteration)",
            "sh_raise.count(iteration - 1)",
            "test_schedule.py::test_the_degree_rises_with_its_window",
        ),
        (
            "schedule: positions learn in scene units",
            'rates.of("position") * extent,',
            'rates.of("position"),',
            "test_units.py::test_a_step_moves_positions_by_the_same_part_of_the_scene",
        ),
    ),
]

_CONFIGURATION = [
    *_in(
        "surfels/channels.py",
        (
            "PLY: quaternions with w last",
            '("rot_1", "rot_2", "rot_3", "rot_0")',
            '("rot_0", "rot_1", "rot_2", "rot_3")',
            "test_ply.py::test_layout_is_that_of_2dgs",
        ),
    ),
    *_in(
        "methods/window.py",
        (
            "schedule: windows forget their start",
            "self._newest(iteration) - math.floor(self.start / self.every + TIE)",
            "self._newest(iteration)",
            "test_config.py::test_a_scaled_window_keeps_its_events",
        ),
        (
            "schedule: one event after the end",
            "math.floor(self.until / self.every + TIE))",
            "math.floor(self.until / self.every + TIE) + 1)",
            "test_config.py::test_a_scaled_window_keeps_its_events",
        ),
    ),
    *_in(
        "methods/method.py",
        (
            "schedule: a stage ends an iteration early",
            "if iteration <= item[1].until",
            "if iteration < item[1].until",
            "test_config.py::test_stages_and_windows_meet_without_gap_or_overlap",
        ),
    ),
    *_in(
        "methods/read.py",
        (
            "schedule: the hold after a propagation is not scaled",
            '"smooth_until", "propagate_hold"}',
            '"smooth_until"}',
            "test_config.py::test_a_preset_scales_every_number_of_iterations",
        ),
        (
            "configuration: extending replaces whole tables",
            "_merge(base[key], value) if both else value",
            "value",
            "test_config.py::test_extends_changes_only_what_it_says",
        ),
        (
            "configuration: --set does not override",
            "table[last] = value",
            "table.setdefault(last, value)",
            "test_config.py::test_assignments_are_applied_unscaled",
        ),
    ),
    *_in(
        "runs/checkpoint.py",
        (
            "checkpoint: the checksum is not compared",
            " or hashlib.sha256(content).hexdigest().encode() != digest:",
            ":",
            "test_checkpoint.py::test_a_flipped_bit_anywhere_is_found",
        ),
        (
            "checkpoint: missing statistics pass",
            "_check(state, rows, (table.count,))",
            "_check(state, [], (table.count,))",
            "test_checkpoint.py::test_wrong_content_is_found_though_its_checksum_is_right",
        ),
    ),
    *_in(
        "runs/run.py",
        (
            "resume: the last line of the log is lost",
            "if _logged(line) <= iteration",
            "if _logged(line) < iteration",
            "test_cli.py::test_an_interrupt_says_how_to_resume_and_resuming_changes_nothing",
        ),
    ),
]

_FILES = [
    *_in(
        "surfels/ply.py",
        (
            "PLY: harmonics coefficient-major",
            "_rest_{rgb * others + k}",
            "_rest_{3 * k + rgb}",
            "test_ply.py::test_layout_is_that_of_2dgs",
        ),
        (
            "PLY: big-endian numbers",
            '(name, "<f4")',
            '(name, ">f4")',
            "test_ply.py::test_layout_is_that_of_2dgs",
        ),
    ),
    *_in(
        "surfels/table.py",
        (
            "surfels: scale is not an exponential",
            "dr.exp(dr.clip(column, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT))",
            "dr.abs(dr.clip(column, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT))",
            "test_surfels.py::test_activations",
        ),
        (
            "surfels: a sign in the rotation",
            "entry(x, z, -y, w)",
            "entry(x, z, y, w)",
            "test_surfels.py::test_activations",
        ),
    ),
    *_in(
        "surfels/init.py",
    ),
    *_in(
        "data/frames.py",
        (
            "data: axes of OpenCV's camera",
            "np.diag([-1.0, 1.0, -1.0, 1.0])",
            "np.diag([-1.0, -1.0, 1.0, 1.0])",
            "test_data.py::test_camera_frame",
        ),
        (
            "data: principal point always at the centre",
            'number("cx") or width / 2',
            'width / 2 or number("cx")',
            "test_data.py::test_intrinsics_per_file_and_per_frame",
        ),
        (
            "data: intrinsics are not scaled down",
            "(x / self.options.downscale for x in self._intrinsics",
            "(x for x in self._intrinsics",
            "test_data.py::test_downscale_averages_composited_pixels",
        ),
        (
            "alpha: background under the object",
            "premultiplied += (1 - alpha[..., None])",
            "premultiplied += alpha[..., None]",
            "test_data.py::test_png_is_composited_as_displayed",
        ),
    ),
    *_in(
        "data/lens.py",
        (
            "lens: p1 and p2 swapped",
            "factor, (p1, p2) = self._series(square)",
            "factor, (p2, p1) = self._series(square)",
            "test_lens.py::test_points_land_where_a_pinhole_sees_them",
        ),
    ),
    *_in(
        "data/pathtrace.py",
        (
            "environment.exr: columns run backwards",
            "dr.cos(theta), -dr.sin(theta) * dr.cos(phi))",
            "dr.cos(theta), dr.sin(theta) * dr.cos(phi))",
            "test_dataset.py::test_environment_in_mitsuba_orientation",
        ),
    ),
    *_in(
        "evaluation/metrics.py",
        (
            "metrics: PSNR from the root of the error",
            "return PSNR_MAX if error <= 0 else min(PSNR_MAX, -10",
            "return PSNR_MAX if error <= 0 else min(PSNR_MAX, -20",
            "test_metrics.py::test_psnr",
        ),
        (
            "metrics: a normal that is turned round has no error",
            "np.arctan2(sine, cosine)",
            "np.arctan2(sine, np.abs(cosine))",
            "test_metrics.py::test_normal_error_over_foreground_and_image",
        ),
        (
            "metrics: correlation of lights with their means",
            "(array - np.average(array, weights=weight) for",
            "(array + 0 * np.average(array, weights=weight) for",
            "test_metrics.py::test_environment_up_to_a_scale_per_channel",
        ),
    ),
]

_PLUGIN = [
    *_in(
        "plugins/light.py",
        (
            "light: rotation transposed",
            "mi.Matrix3f(np.linalg.inv(matrix)",
            "mi.Matrix3f((matrix)",
            "test_emitter_light.py::test_radiance_is_that_of_mitsuba",
        ),
    ),
    *_in(
        "plugins/integrator.py",
        (
            "plugin: background not under alpha",
            "rgb + (1 - frame.alpha) * self.background",
            "rgb + self.background",
            "test_integrator.py::test_background_is_under_alpha",
        ),
        (
            "plugin: samples of a pixel along its diagonal",
            "(pixel % camera.width) * factor + part % factor",
            "(pixel % camera.width) * factor + part // factor",
            "test_integrator_images.py::test_supersampling_is_a_box_filter_over_pixel_centres",
        ),
        (
            "plugin: parameters named by an address",
            'self.set_id("refgs")',
            "self.id()",
            "test_integrator.py::test_parameter_keys_do_not_depend_on_the_address",
        ),
        (
            "plugin: AOVs in reverse",
            "for aov in self.aovs:",
            "for aov in reversed(self.aovs):",
            "test_integrator_images.py::test_aovs_follow_mitsubas_names",
        ),
    ),
    *_in(
        "plugins/aovs.py",
        (
            "plugin: depth along the axis",
            "(frame.depth - camera.near) * dr.norm(camera.rays())",
            "(frame.depth - camera.near) * 1",
            "test_integrator_images.py::test_depth_is_that_of_mitsuba",
        ),
    ),
    *_in(
        "cli/render.py",
        (
            "sRGB: PNG files of linear values",
            "colour = srgb_from_linear(pixels[..., :3] / np.maximum(alpha, 1e-8))",
            "colour = pixels[..., :3] / np.maximum(alpha, 1e-8)",
            "test_cli.py::test_render_writes_exr_with_aovs_and_png",
        ),
    ),
    *_in(
        "llvm.py",
        (
            "doctor: LLVM 15 will do",
            "MINIMUM_MAJOR = 17",
            "MINIMUM_MAJOR = 15",
            "test_llvm.py",
        ),
    ),
]

MISTAKES = (
    *_CONSTANTS,
    *_FOOTPRINT,
    *_TILES,
    *_BLEND,
    *_CAMERA,
    *_PIPELINE,
    *_RENDER,
    *_SHADE,
    *_OCCLUSION,
    *_LOSSES,
    *_OPTIMISER,
    *_CONFIGURATION,
    *_FILES,
    *_PLUGIN,
)
