function build_model(fmu, period)
% A Simulink model with an observer's FMU in it: build_model('axis.fmu', 1e-3)
model = 'axis_model';
new_system(model);
open_system(model);
block = [model '/axis'];
add_block('simulink_extras/FMU Import/FMU', block, 'FMUName', fmu, 'Position', [200 60 360 200]);
set_param(model, 'Solver', 'FixedStepDiscrete', 'FixedStep', num2str(period));
ports = get_param(block, 'Ports');
for i = 1:ports(1)
    source = sprintf('%s/In%d', model, i);
    add_block('simulink/Sources/In1', source, 'SampleTime', num2str(period), 'Position', [80 45 + 40 * i 110 59 + 40 * i]);
    add_line(model, sprintf('In%d/1', i), sprintf('axis/%d', i));
end
for i = 1:ports(2)
    sink = sprintf('%s/Out%d', model, i);
    add_block('simulink/Sinks/Out1', sink, 'Position', [460 45 + 40 * i 490 59 + 40 * i]);
    add_line(model, sprintf('axis/%d', i), sprintf('Out%d/1', i));
end
save_system(model);
end
